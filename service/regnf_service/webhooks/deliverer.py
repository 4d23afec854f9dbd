"""Takes messages from the outbox and sends them until they are received, or for some 32 hours in vain."""

from __future__ import annotations

import json
import logging
from collections.abc import Collection
from dataclasses import replace

from anyio import CapacityLimiter, to_thread

from regnf_service.times import rfc3339
from regnf_service.webhooks.sender import HttpSender, SendError
from regnf_service.webhooks.signing import Secrets, signed_headers
from regnf_service.webhooks.targets import AllowList
from regnf_state.record_store import RecordStore
from regnf_state.records import FINISHED, JobRecord, UnreadableRecordError
from regnf_state.redis.webhook_outbox import Delivery, Message, RedisOutbox

logger = logging.getLogger(__name__)
BACK_OFF_S = (5.0, 30.0, 120.0, 600.0, 1800.0, 3600.0, 2 * 3600.0, 4 * 3600.0, 8 * 3600.0, 16 * 3600.0)
"""Pauses before the second send, the third, and so on; after the last the message is given up."""
_GONE = 410
"""A receiver that answers so wants no more."""


class Deliverer:
    """Call ``claim`` and ``deliver`` again and again, for as many messages at once as like, in many processes.

    threads: for calls of the stores, which block; None: any.
    """

    def __init__(
        self,
        records: RecordStore,
        outbox: RedisOutbox,
        sender: HttpSender,
        allowed: AllowList,
        secrets: Secrets,
        back_off_s: tuple[float, ...] = BACK_OFF_S,
        threads: CapacityLimiter | None = None,
    ) -> None:
        self._records = records
        self._outbox = outbox
        self._sender = sender
        self._allowed = allowed
        self._secrets = secrets
        self._back_off_s = back_off_s
        self._threads = threads

    def claim(self, passed_over: Collection[str] = ()) -> Message | None:
        """A message that is due, None when none is. It comes up again if it is not delivered within a minute.

        passed_over: lines and callers whose messages wait. Raises RedisError.
        """
        return self._outbox.claim(passed_over)

    async def deliver(self, message: Message) -> None:
        """Send a message and write down how that went. Raises RedisError: the message comes up again."""
        found = await to_thread.run_sync(self._look_up, message, limiter=self._threads)
        if found is not None:
            record, known, now = found
            sent = await self._send(record, message.place, now)
            told = replace(known, sends=known.sends + 1, next_at=None)
            await to_thread.run_sync(self._settle, message, told, *sent, limiter=self._threads)

    def _look_up(self, message: Message) -> tuple[JobRecord, Delivery, float] | None:
        """What the message is about, how it fared so far, and the store's time; None where it is not to be sent."""
        try:
            record = self._records.get_job(message.job_id)
        except UnreadableRecordError as error:
            if error.newer:
                return None  # it comes up again in a minute: a process of the later release may send it
            record = None
        if record is None or not _is_about(message, record):
            self._outbox.settle(message, Delivery("failed", last_error="JOB_GONE"))
            return None
        return record, self._outbox.deliveries(record)[message.place], self._records.now()

    async def _send(self, record: JobRecord, place: int, now: float) -> tuple[int | None, str | None]:
        """Status of the answer, or a word for why there was none."""
        url, keys = record.webhooks[place], self._secrets.get(record.owner)
        if not keys or not self._allowed.allows(url):
            return None, "WEBHOOK_NOT_ALLOWED"
        body = payload(record)
        headers = signed_headers(keys, message_id(record, place), int(now), body) | {"Content-Type": "application/json"}
        try:
            return await self._sender.send(url, headers, body), None
        except SendError as error:
            return None, error.reason

    def _settle(self, message: Message, sent: Delivery, status: int | None, error: str | None) -> None:
        now = self._records.now()
        sent = replace(sent, last_status=status, last_error=error)
        if status is not None and 200 <= status < 300:
            sent = replace(sent, state="delivered", delivered_at=now)
        elif status == _GONE or sent.sends > len(self._back_off_s):
            sent = replace(sent, state="failed")
        else:
            sent = replace(sent, state="pending", next_at=now + self._back_off_s[sent.sends - 1])
        logger.info(
            "webhook %s, send %d: %s", message.name, sent.sends, sent.state, extra={"status": status, "error": error}
        )
        outcome = "delivered" if sent.state == "delivered" else error or f"status_{(status or 0) // 100}xx"
        self._outbox.settle(message, sent, outcome)


def _is_about(message: Message, record: JobRecord) -> bool:
    """Whether the record is at the end that the message tells of."""
    return record.attempt == message.attempt and record.status in FINISHED and message.place < len(record.webhooks)


def message_id(record: JobRecord, place: int) -> str:
    """Each message's own: the same at every send, another when a job is deleted, asked for anew and ends again."""
    return f"{record.id}-{record.attempt}-{int(1000 * (record.finished or 0))}-{place}"


def payload(record: JobRecord) -> bytes:
    """The message: the same bytes at every send. It says that a job ended and how; what it found is asked for."""
    document = {
        "type": f"job.{record.status}",
        "timestamp": rfc3339(record.finished),
        "data": {
            "id": record.id,
            "kind": record.kind,
            "status": record.status,
            "attempt": record.attempt,
            "reason": None if record.error is None else record.error.get("reason"),
        },
    }
    return json.dumps(document, separators=(",", ":")).encode()
