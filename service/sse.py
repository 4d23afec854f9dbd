"""A job's events as a stream of server-sent events (WHATWG HTML, section 9.2)."""

from __future__ import annotations

import json
import time
from collections.abc import AsyncIterator

from service.dependencies import Services, off_loop
from service.records import FINISHED, JobEvent
from service.waiting import pause

MEDIA_TYPE = "text/event-stream"
_POLL_S = 0.2
_HEARTBEAT_S = 10.0
_RECONNECT_MS = 2000


def format_event(event: JobEvent) -> str:
    """One event. JSON without line breaks needs no splitting."""
    return f"id: {event.id}\nevent: {event.name}\ndata: {json.dumps(event.data)}\n\n"


async def event_stream(services: Services, job_id: str, after: str | None) -> AsyncIterator[str]:
    """The job's events after the given one, until it has finished, is gone, or the service stops.

    A comment every ten seconds keeps proxies from taking the connection for dead.
    """
    yield f"retry: {_RECONNECT_MS}\n\n"
    last_sent = time.monotonic()
    while True:
        # the record first: what it says has finished has all its events in the stream read next
        record = await off_loop(services.records.get_job, job_id)
        events = await off_loop(services.records.events, job_id, after, 0.0)
        for event in events:
            yield format_event(event)
            after = event.id
        if events:
            last_sent = time.monotonic()
        if record is None or record.status in FINISHED:
            return
        if time.monotonic() - last_sent >= _HEARTBEAT_S:
            yield ": still here\n\n"
            last_sent = time.monotonic()
        if await pause(_POLL_S, services.stopping):
            return
