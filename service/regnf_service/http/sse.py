"""A job's events as a stream of server-sent events (WHATWG HTML, section 9.2)."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import AsyncIterator

from redis.exceptions import RedisError
from starlette.responses import StreamingResponse
from starlette.types import Receive, Scope, Send

from regnf_service.concurrency import Slots
from regnf_service.services import Services
from regnf_state.records import FINISHED

MEDIA_TYPE = "text/event-stream"
logger = logging.getLogger(__name__)
_HEARTBEAT_S = 10.0
_RECONNECT_MS = 2000


async def event_stream(services: Services, job_id: str, after: str | None) -> AsyncIterator[str]:
    """The job's events after the given one, until it has finished, is gone, a store is away, or the service stops.

    A comment every ten seconds keeps proxies from taking the connection for dead.
    """
    yield f"retry: {_RECONNECT_MS}\n\n"
    last_sent = time.monotonic()
    while not services.stopping.is_set():
        try:
            record, events = await services.job_watch.news(job_id, after)
        except (RedisError, OSError) as error:
            # the client connects again, and is told when with the 503 that it then gets
            logger.warning("an event stream ends: a store does not respond: %s", type(error).__name__)
            return
        for event in events:
            yield f"id: {event.id}\nevent: {event.name}\ndata: {json.dumps(event.data)}\n\n"
            after = event.id
        if events:
            last_sent = time.monotonic()
        if record is None or record.status in FINISHED:
            return
        if time.monotonic() - last_sent >= _HEARTBEAT_S:
            yield ": still here\n\n"
            last_sent = time.monotonic()


class EventStream(StreamingResponse):
    """A stream as one of those that a caller may read at once: held while it is sent, however that ends.

    Raises Problem TOO_MANY_REQUESTS_AT_ONCE before anything is sent.
    """

    def __init__(self, slots: Slots, caller: str, stream: AsyncIterator[str]) -> None:
        headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
        super().__init__(stream, media_type=MEDIA_TYPE, headers=headers)
        self._slots = slots
        self._caller = caller

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        with self._slots.held(self._caller):
            await super().__call__(scope, receive, send)
