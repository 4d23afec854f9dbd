"""What Prometheus scrapes: requests of this process, and what Redis knows of jobs, imports, workers and webhooks."""

from __future__ import annotations

import resource
import socket
import threading
import time
from collections import Counter as Tally
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from http import HTTPStatus
from http.server import ThreadingHTTPServer
from pathlib import Path
from typing import Any

from prometheus_client import CollectorRegistry, Counter, Histogram
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.exposition import MetricsHandler
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector
from redis.exceptions import RedisError
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from regnf_service.http.connections import Connections
from regnf_service.http.hosts import AllowedHosts, parse_authority
from regnf_service.http.middleware import route_of
from regnf_service.http.problems import SECURITY_HEADERS
from regnf_service.services import Services
from regnf_state.redis.counters import Counters
from regnf_state.redis.fair_queue import FairQueue
from regnf_state.redis.webhook_outbox import RedisOutbox

# File descriptors of this process: raised to what the system allows, shared out, and counted.

_ENOUGH = 65536
_LARGEST_BACKLOG = 2048
_LARGEST_RESERVE = 512


@dataclass(frozen=True)
class Share:
    """backlog: connections that one look at the socket may take in · connections: how many may stay.

    The rest is kept for stores, files, and whoever is just being refused: so `accept` never fails for want of one.
    """

    backlog: int
    connections: int


def raise_limit() -> int:
    """Allow as many as the system does, up to a number that is enough; returns how many may be open now."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    unlimited = resource.RLIM_INFINITY
    wanted = _ENOUGH if hard == unlimited else min(hard, _ENOUGH)
    if soft != unlimited and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
        soft = wanted
    return _ENOUGH if soft == unlimited else soft


def shared_out(limit: int, most_connections: int) -> Share:
    """What connections may have of ``limit`` descriptors: at least a quarter of them are for nothing else."""
    backlog = min(_LARGEST_BACKLOG, limit // 4)
    reserve = min(_LARGEST_RESERVE, 3 * limit // 8)
    return Share(backlog, max(1, min(most_connections, limit - backlog - reserve)))


def open_descriptors() -> int:
    """How many are open; 0 where the system does not tell."""
    try:
        return sum(1 for _ in Path("/proc/self/fd").iterdir())
    except OSError:
        return 0


# What callers have waiting, for Prometheus. The names of callers are labels, so only so many are told apart.

_MOST_CALLERS = 32
OTHER = "other"
"""The label of all the rest."""


def fairness_metrics(fair: FairQueue) -> Iterator[Metric]:
    """What each caller has waiting, and for how long."""
    waiting = _by_caller("waiting", "Jobs and imports that wait, by caller.")
    oldest = _by_caller("wait_seconds", "How long the first of them has waited.")
    lines = fair.lines()
    for line in lines[:_MOST_CALLERS]:
        waiting.add_metric((line.owner,), line.waiting)
        oldest.add_metric((line.owner,), line.oldest_s)
    if rest := lines[_MOST_CALLERS:]:
        waiting.add_metric((OTHER,), sum(line.waiting for line in rest))
        oldest.add_metric((OTHER,), max(line.oldest_s for line in rest))
    yield from (waiting, oldest)


def _by_caller(name: str, about: str) -> GaugeMetricFamily:
    return GaugeMetricFamily(f"regnf_caller_{name}", about, labels=("caller",))


_COUNTS = {
    "job_attempts": ("Times that a job was handed to the workers.", ()),
    "jobs_finished": ("Jobs that have ended.", ("status", "verdict", "reason")),
    "imports": ("Imports that have ended.", ("state", "reason")),
    "jobs_evicted": ("Finished jobs that went before their time, to make room.", ()),
    "records_unreadable": ("Records that could not be read, by what they were of.", ("kind",)),
    "queue_payloads_refused": ("Entries in the queue that this service has not written.", ("queue",)),
    "webhook_sends": ("Messages about jobs that were sent, or not.", ("outcome",)),
}
_TIMES = {
    "job_wait_seconds": ("From a job's acceptance to its start.", ()),
    "job_run_seconds": ("From a job's start to its end.", ("status",)),
    "job_phase_seconds": ("Time in a phase.", ("phase",)),
    "import_seconds": ("From an upload to the end of its import, waiting included.", ()),
}


class Metrics:
    """The registry of one application. Routes are counted by their templates, never by the ids in them."""

    def __init__(self, services: Services, connections: Connections | None = None) -> None:
        self.registry = CollectorRegistry()
        self.requests = Counter(
            "regnf_http_requests", "Requests answered.", ("method", "route", "status"), registry=self.registry
        )
        self.seconds = Histogram(
            "regnf_http_request_seconds", "Until the answer began.", ("route",), registry=self.registry
        )
        self.received = Counter("regnf_received_bytes", "Bytes of bodies.", ("route",), registry=self.registry)
        self.redis_errors = Counter(
            "regnf_redis_errors", "Answers and scrapes for which Redis was away.", registry=self.registry
        )
        self.registry.register(_Process(connections))
        self.quota_refusals = Counter(
            "regnf_quota_refusals",
            "Calls refused because of what their caller has.",
            ("reason",),
            registry=self.registry,
        )
        self.registry.register(_Held(self, services))


class _Process(Collector):
    """Connections and descriptors of this process."""

    def __init__(self, connections: Connections | None) -> None:
        self._connections = connections

    def collect(self) -> Iterator[Metric]:
        yield _gauge("open_file_descriptors", "Files and connections that are open.", open_descriptors())
        yield _gauge("file_descriptor_limit", "How many may be open.", resource.getrlimit(resource.RLIMIT_NOFILE)[0])
        if self._connections is not None:
            yield _gauge("connections", "Open connections.", len(self._connections))
            refused = CounterMetricFamily(
                "regnf_connections_refused", "Connections that were refused or closed early.", labels=("cause",)
            )
            for cause, count in sorted(self._connections.ended.items()):
                refused.add_metric((cause,), count)
            yield refused


class _Held(Collector):
    """Asks Redis at each scrape."""

    def __init__(self, metrics: Metrics, services: Services) -> None:
        self._metrics = metrics
        self._services = services

    def describe(self) -> Iterable[Metric]:
        """Nothing to compare beforehand: that would be a scrape."""
        return ()

    def collect(self) -> Iterator[Metric]:
        services = self._services
        yield _gauge("uploads_active", "Uploads under way.", services.uploads.taken)
        yield _gauge("streams_active", "Event streams being read.", services.streams.taken)
        try:
            held = list(self._ask())
        except RedisError:
            self._metrics.redis_errors.inc()
            yield _gauge("redis_up", "Whether Redis answered this scrape.", 0)
            return
        yield _gauge("redis_up", "Whether Redis answered this scrape.", 1)
        yield from held

    def _ask(self) -> Iterator[Metric]:
        services = self._services
        active = services.records.active_jobs()
        yield _gauge("queue_depth", "Jobs that wait for a worker.", sum(job.status == "accepted" for job in active))
        jobs = GaugeMetricFamily("regnf_jobs_active", "Jobs that wait or run.", labels=("status", "phase"))
        for labels, count in sorted(Tally((job.status, job.phase or "") for job in active).items()):
            jobs.add_metric(labels, count)
        yield jobs
        imports = len(services.records.validating_fields())
        yield _gauge("imports_active", "Imports that wait or run.", imports)
        yield _gauge(
            "unfinished", "Jobs and imports that wait or run: what workers are needed for.", len(active) + imports
        )
        yield _gauge("workers", "Workers that have reported lately.", services.queue.live_workers())
        yield _gauge("webhooks_waiting", "Messages still to be sent.", RedisOutbox(services.redis).waiting())
        yield _gauge("records_set_aside", "Records known to be unreadable.", services.records.unreadable.total())
        yield from fairness_metrics(services.queue)
        counters = Counters(services.redis)
        for name, (about, names) in _COUNTS.items():
            counter = CounterMetricFamily(f"regnf_{name}", about, labels=names)
            for counted, value in counters.counts(name):
                counter.add_metric(counted, value)
            yield counter
        for name, (about, names) in _TIMES.items():
            times = HistogramMetricFamily(f"regnf_{name}", about, labels=names)
            for group, buckets, total in counters.times(name):
                times.add_metric(group, buckets, total)
            yield times


def _gauge(name: str, about: str, value: float) -> GaugeMetricFamily:
    return GaugeMetricFamily(f"regnf_{name}", about, value=value)


class Measured:
    """Counts every request that passes."""

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self._app = app
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        began, status, received = time.perf_counter(), 500, 0
        answered: float | None = None

        async def counting_receive() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            return message

        async def noting_send(message: Message) -> None:
            nonlocal status, answered
            if message["type"] == "http.response.start":
                status, answered = message["status"], time.perf_counter()
            await send(message)

        try:
            await self._app(scope, counting_receive, noting_send)
        finally:
            route, method = route_of(scope), scope["method"]
            known = method if method in ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE") else "other"
            self._metrics.requests.labels(known, route, str(status)).inc()
            self._metrics.seconds.labels(route).observe((answered or time.perf_counter()) - began)
            if received:
                self._metrics.received.labels(route).inc(received)


# `/metrics` on a port of its own: for Prometheus, not for web pages, and with few connections at once.

_MOST_CONNECTIONS = 16
_SILENCE_S = 5.0
"""How long a scraper may send nothing, or read nothing."""
_LONGEST_S = 15.0
"""How long one scrape may take in all: who sends a byte now and then must not keep a connection for hours."""


@contextmanager
def served(registry: CollectorRegistry, hosts: AllowedHosts, address: str | None) -> Iterator[None]:
    """Answer scrapes at `host:port` while the context lasts; no address: not at all."""
    if address is None:
        yield
        return
    handler = type("_Handler", (_Handler,), {"registry": registry, "hosts": hosts})
    host, _, port = address.rpartition(":")
    server = _Server((host.strip("[]"), int(port)), handler)
    thread = threading.Thread(target=server.serve_forever, name="metrics", daemon=True)
    thread.start()
    try:
        yield
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


class _Handler(MetricsHandler):
    hosts: AllowedHosts
    timeout = _SILENCE_S

    def do_GET(self) -> None:  # noqa: N802 -- the base class dispatches by this name
        given = self.headers.get_all("Host") or []
        host = parse_authority(given[0]) if len(given) == 1 else None
        if host is None or not self.hosts.knows(host, str(self.connection.getsockname()[0])):
            self.send_error(HTTPStatus.MISDIRECTED_REQUEST, "Host not allowed: see REGNF_ALLOWED_HOSTS")
        elif self.headers.get("Origin") is not None or self.headers.get("Sec-Fetch-Site", "none") != "none":
            self.send_error(HTTPStatus.FORBIDDEN, "Origin not allowed")
        else:
            super().do_GET()

    def end_headers(self) -> None:
        for name, value in SECURITY_HEADERS.items():
            self.send_header(name, value)
        super().end_headers()


class _Server(ThreadingHTTPServer):
    """A thread a connection, and no more of them than a few: others are closed at once."""

    daemon_threads = True
    block_on_close = False

    def __init__(self, address: tuple[str, int], handler: type[MetricsHandler]) -> None:
        found = socket.getaddrinfo(*address, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        self.address_family = found[0]
        self._slots = threading.BoundedSemaphore(_MOST_CONNECTIONS)
        super().__init__((str(found[4][0]), int(found[4][1])), handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        if self._slots.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        ending = threading.Timer(_LONGEST_S, _cut_off, (request,))
        ending.daemon = True
        ending.start()
        try:
            super().process_request_thread(request, client_address)
        finally:
            ending.cancel()
            self._slots.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A scraper that leaves is no error of ours."""


def _cut_off(connection: socket.socket) -> None:
    """Whoever reads from or writes to the connection finds that it has ended."""
    with suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)
