"""A receiver of webhooks, and what the tests of them share: jobs that end, and how their messages fare."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest
from redis import Redis

from regnf_service.webhooks.service import Deliverer
from regnf_service.webhooks.targets import AllowList, Webhooks, read_secrets
from regnf_state.ownership import reference_of
from regnf_state.records import JobRecord
from regnf_state.redis.jobs import RecordStore
from regnf_state.redis.webhook_outbox import Delivery, RedisOutbox, due_key, line_of

KEY = bytes(range(24))


SECRET = f"whsec_{base64.b64encode(KEY).decode()}"


def hmac_by_hand(key: bytes, message: bytes) -> bytes:
    """HMAC-SHA256 from its definition (RFC 2104), for keys of at most 64 bytes."""
    padded = key.ljust(64, b"\0")
    inner = hashlib.sha256(bytes(byte ^ 0x36 for byte in padded) + message).digest()
    return hashlib.sha256(bytes(byte ^ 0x5C for byte in padded) + inner).digest()


class Receiver:
    """Answers with the statuses it is given, the last one for ever; keeps what it was sent."""

    def __init__(self) -> None:
        self.statuses = [200]
        self.location = ""
        self.received: list[tuple[str, dict[str, str], bytes]] = []
        self.address = ""


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    made = Receiver()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            made.received.append((self.path, {name.lower(): value for name, value in self.headers.items()}, body))
            self.send_response(made.statuses.pop(0) if len(made.statuses) > 1 else made.statuses[0])
            if made.location:
                self.send_header("Location", made.location)
            self.end_headers()

        def log_message(self, *_: Any) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        made.address = f"http://127.0.0.1:{server.server_port}"
        yield made
        server.shutdown()
        thread.join()


class OneByOne:
    def __init__(self, records: RecordStore, webhooks: Webhooks, back_off_s: tuple[float, ...]) -> None:
        self._outbox, self._inner = webhooks.outbox, Deliverer(records, webhooks, back_off_s)

    def run_once(self) -> bool:
        message = self._outbox.claim()
        if message is not None:
            asyncio.run(self._inner.deliver(message))
        return message is not None


def deliverer(redis: Redis, allowed: list[str], back_off_s: tuple[float, ...] = (0.0, 0.0)) -> OneByOne:
    secrets = read_secrets([f"alice:{SECRET}"])
    return OneByOne(RecordStore(redis), Webhooks(AllowList(allowed), secrets, RedisOutbox(redis)), back_off_s)


def due(url: str) -> str:
    return due_key(line_of("alice", url))


def finish(redis: Redis, url: str, status: str = "successful", name: str = "j1", owner: str = "alice") -> JobRecord:
    store = RecordStore(redis)
    request = {"scene": reference_of(owner, "a" * 64), "webhook": {"url": url}}
    now = store.now()
    record, _ = store.create_job(JobRecord(name, "registration", "accepted", request, {}, now, now), 10)
    error = {"reason": "NO_SURFACE_IN_DETECTION", "detail": "text"} if status == "failed" else None
    store.update_job(name, record.attempt, status="running")
    return store.update_job(name, record.attempt, status=status, error=error)


def delivery(redis: Redis, place: int = 0, name: str = "j1") -> Delivery:
    record = RecordStore(redis).get_job(name)
    assert record is not None
    return RedisOutbox(redis).deliveries(record)[place]


def ask(redis: Redis, url: str, name: str = "j1") -> JobRecord:
    """Another request of alice's for the same job, with a webhook of its own."""
    store = RecordStore(redis)
    request = {"scene": reference_of("alice", "a" * 64), "webhook": {"url": url}}
    now = store.now()
    return store.create_job(JobRecord(name, "registration", "accepted", request, {}, now, now), 10)[0]
