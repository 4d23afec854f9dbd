"""Webhooks as a part of the running service: made from its settings, and delivered beside its requests."""

from __future__ import annotations

import asyncio
import json
import logging
import socket
import ssl
import threading
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any, TypeVar

import httpcore
from anyio import CapacityLimiter, to_thread
from redis import Redis
from redis.exceptions import RedisError

from regnf_service.times import rfc3339
from regnf_service.webhooks.targets import AllowList, Webhooks, read_secrets, signed_headers
from regnf_state.records import FINISHED, JobRecord, UnreadableRecordError
from regnf_state.redis.jobs import RecordStore
from regnf_state.redis.webhook_outbox import Delivery, Message, RedisOutbox
from regnf_state.settings import Settings

# Sending one message: a POST to an address that was looked at, redirects not followed, the answer's body not read.

TIMEOUT_S = 10.0
"""For everything together: the name, the connection, the handshake, the message and the answer's head."""
_NEXT_ADDRESS_S = 3.0
"""Of a name with several addresses the next one is tried after this."""
_ANSWER_BYTES = 64 << 10
"""Of the answer, until its status is there. Interim answers (1xx) may come without end."""


class SendError(Exception):
    """No answer came. ``reason`` is a word for it; addresses and the like stay out of it."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


class _BoundedStream(httpcore.AsyncNetworkStream):
    """A connection that gives so many bytes and no more."""

    def __init__(self, inner: httpcore.AsyncNetworkStream, left: int) -> None:
        self._inner = inner
        self._left = left

    async def read(self, max_bytes: int, timeout: float | None = None) -> bytes:
        if not self._left:
            raise SendError("ANSWER_TOO_LARGE")
        found = await self._inner.read(min(max_bytes, self._left), timeout)
        self._left -= len(found)
        return found

    async def write(self, buffer: bytes, timeout: float | None = None) -> None:
        await self._inner.write(buffer, timeout)

    async def aclose(self) -> None:
        await self._inner.aclose()

    async def start_tls(
        self, ssl_context: ssl.SSLContext, server_hostname: str | None = None, timeout: float | None = None
    ) -> httpcore.AsyncNetworkStream:
        try:
            return _BoundedStream(await self._inner.start_tls(ssl_context, server_hostname, timeout), self._left)
        except BaseException:  # httpcore does not close a connection whose handshake is broken off
            await self._inner.aclose()
            raise

    def get_extra_info(self, info: str) -> Any:
        return self._inner.get_extra_info(info)


class _GuardedNetwork(httpcore.AsyncNetworkBackend):
    """Connects to the very addresses that it has checked, so that a name cannot resolve to others in between."""

    def __init__(self, permits: Callable[[str], bool]) -> None:
        self._permits = permits
        self._inner = httpcore.AnyIOBackend()
        self._lookups: dict[tuple[str, int], asyncio.Future[list[str]]] = {}

    async def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,
        local_address: str | None = None,  # noqa: ARG002
        socket_options: Iterable[Any] | None = None,  # noqa: ARG002
    ) -> httpcore.AsyncNetworkStream:
        addresses = await self._addresses(host, port)
        if not addresses:
            raise SendError("UNRESOLVED")
        if not all(map(self._permits, addresses)):
            raise SendError("ADDRESS_NOT_ALLOWED")
        for address in addresses[:-1]:
            with suppress(httpcore.ConnectError, httpcore.ConnectTimeout):
                return await self._connected(address, port, _NEXT_ADDRESS_S)
        return await self._connected(addresses[-1], port, timeout)

    async def _connected(self, address: str, port: int, timeout: float | None) -> httpcore.AsyncNetworkStream:
        return _BoundedStream(await self._inner.connect_tcp(address, port, timeout), _ANSWER_BYTES)

    async def _addresses(self, host: str, port: int) -> list[str]:
        """Those of a name. However many ask for it, one thread at a time looks it up.

        A lookup cannot be broken off. Its thread is a daemon, so that the process need not wait for it at its end.
        """
        asked = self._lookups.get((host, port))
        if asked is None or asked.get_loop() is not asyncio.get_running_loop():
            asked = self._lookups[host, port] = asyncio.get_running_loop().create_future()
            asked.add_done_callback(lambda _: self._lookups.pop((host, port), None))
            threading.Thread(target=_look_up, args=(host, port, asked), name="webhook name", daemon=True).start()
        return await asyncio.shield(asked)

    async def connect_unix_socket(self, *_: Any, **__: Any) -> httpcore.AsyncNetworkStream:
        raise SendError("ADDRESS_NOT_ALLOWED")


def _look_up(host: str, port: int, asked: asyncio.Future[list[str]]) -> None:
    """Give ``asked`` the addresses; none where the name has none."""
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError):
        found = []
    addresses = list(dict.fromkeys(str(entry[4][0]) for entry in found))

    def tell() -> None:
        if not asked.done():
            asked.set_result(addresses)

    with suppress(RuntimeError):  # the loop was closed in the meantime
        asked.get_loop().call_soon_threadsafe(tell)


class HttpSender:
    """Sends over TCP and TLS with certificates checked. ``permits`` says which addresses may be connected to."""

    def __init__(self, permits: Callable[[str], bool], timeout_s: float = TIMEOUT_S) -> None:
        self._network = _GuardedNetwork(permits)
        self._tls = httpcore.default_ssl_context()
        self._timeout_s = timeout_s

    async def send(self, url: str, headers: Mapping[str, str], body: bytes) -> int:
        """The status of the answer. Nothing that the receiver does or leaves undone makes it last longer than the time
        limit. Raises SendError."""
        given = [*headers.items(), ("Connection", "close")]
        try:
            async with (
                asyncio.timeout(self._timeout_s),
                httpcore.AsyncConnectionPool(self._tls, network_backend=self._network) as pool,
                pool.stream("POST", url, headers=given, content=body) as answer,
            ):
                return int(answer.status)
        except (TimeoutError, httpcore.TimeoutException) as error:
            raise SendError("TIMEOUT") from error
        except (httpcore.NetworkError, httpcore.ProtocolError, OSError) as error:
            raise SendError("CONNECTION_FAILED") from error


# Takes messages from the outbox and sends them until they are received, or for some 32 hours in vain.

BACK_OFF_S = (5.0, 30.0, 120.0, 600.0, 1800.0, 3600.0, 2 * 3600.0, 4 * 3600.0, 8 * 3600.0, 16 * 3600.0)
"""Pauses before the second send, the third, and so on; after the last the message is given up."""
_GONE = 410
"""A receiver that answers so wants no more."""


class Deliverer:
    """Sends messages that were claimed of the outbox, as many at once as like, in many processes.

    threads: for calls of the stores, which block; None: any.
    """

    def __init__(
        self,
        records: RecordStore,
        webhooks: Webhooks,
        back_off_s: tuple[float, ...] = BACK_OFF_S,
        threads: CapacityLimiter | None = None,
    ) -> None:
        self._records = records
        self._webhooks = webhooks
        self._outbox = webhooks.outbox
        self._sender = HttpSender(webhooks.allowed.permits)
        self._back_off_s = back_off_s
        self._threads = threads

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
        current = record is not None and record.attempt == message.attempt and record.status in FINISHED
        if record is None or not current or message.place >= len(record.webhooks):
            self._outbox.settle(message, Delivery("failed", last_error="JOB_GONE"))
            return None
        return record, self._outbox.deliveries(record)[message.place], self._records.now()

    async def _send(self, record: JobRecord, place: int, now: float) -> tuple[int | None, str | None]:
        """Status of the answer, or a word for why there was none."""
        url, keys = record.webhooks[place], self._webhooks.secrets.get(record.owner)
        if not keys or not self._webhooks.allowed.allows(url):
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


def message_id(record: JobRecord, place: int) -> str:
    """Each message's own: the same at every send, another when a job is deleted, requested again and ends again."""
    return f"{record.id}-{record.attempt}-{int(1000 * (record.finished or 0))}-{place}"


def payload(record: JobRecord) -> bytes:
    """The message: the same bytes at every send. It says that a job ended and how; what it found is requested."""
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


logger = logging.getLogger(__name__)
_Result = TypeVar("_Result")
_AT_ONCE, _OF_A_CALLER, _OF_A_LINE = 64, 16, 4
"""Messages under way: of all callers, of one, and of one to one receiver."""
_STORE_THREADS = 4
_LOOK_EVERY_S = 1.0
_LAST_S = 1.0
"""Messages under way have so long when the service stops. The others are sent again by whoever starts next."""


def webhooks_of(settings: Settings, redis: Redis) -> Webhooks:
    """What the settings say of webhooks. Raises TokensError."""
    secrets = read_secrets(settings.webhook_secrets)
    return Webhooks(AllowList(settings.webhook_hosts), secrets, RedisOutbox(redis))


async def deliver_until_stopped(webhooks: Webhooks, records: RecordStore, stopping: asyncio.Event) -> None:
    """Send what is due until the service stops; nothing where no host is allowed.

    A receiver that does not answer keeps only its own messages of its own caller waiting.
    """
    if not webhooks.allowed:
        return
    threads = CapacityLimiter(_STORE_THREADS)
    deliverer = Deliverer(records, webhooks, threads=threads)
    under_way: dict[asyncio.Task[None], Message] = {}
    stop = asyncio.create_task(stopping.wait())
    while not stopping.is_set():
        message = None
        if len(under_way) < _AT_ONCE:
            claim = to_thread.run_sync(webhooks.outbox.claim, full(under_way.values()), limiter=threads)
            message = await _guarded(claim)
        if message is not None:
            under_way[asyncio.create_task(_guarded(deliverer.deliver(message)))] = message
            continue
        done, _ = await asyncio.wait({stop, *under_way}, timeout=_LOOK_EVERY_S, return_when=asyncio.FIRST_COMPLETED)
        under_way = {task: message for task, message in under_way.items() if task not in done}
    if under_way:
        _, late = await asyncio.wait(under_way, timeout=_LAST_S)
        for task in late:
            task.cancel()
        await asyncio.gather(*late, return_exceptions=True)


def full(under_way: Iterable[Message]) -> list[str]:
    """The lines, and the callers, that have as many messages under way as they may."""
    messages = list(under_way)
    lines, callers = Counter(one.line for one in messages), Counter(one.caller for one in messages)
    return [
        *(line for line, count in lines.items() if count >= _OF_A_LINE),
        *(caller for caller, count in callers.items() if count >= _OF_A_CALLER),
    ]


async def _guarded(work: Awaitable[_Result]) -> _Result | None:
    """What the work gives; None where it failed, which is logged: a message that was not sent comes up again."""
    try:
        return await work
    except RedisError as error:
        logger.warning("webhooks wait for Redis: %s", type(error).__name__)
    except Exception:
        logger.exception("an internal error: a message of the outbox is sent again")
    return None
