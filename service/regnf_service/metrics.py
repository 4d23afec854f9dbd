"""What Prometheus scrapes: requests of this process, and what Redis knows of jobs, imports, workers and webhooks."""

from __future__ import annotations

import resource
import time
from collections import Counter as Tally
from collections.abc import Iterable, Iterator

from prometheus_client import CollectorRegistry, Counter, Histogram
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector
from redis.exceptions import RedisError
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from regnf_service.descriptors import open_descriptors
from regnf_service.fairness_metrics import fairness_metrics
from regnf_service.http.connections import Connections
from regnf_service.http.middleware import route_of
from regnf_service.services import Services
from regnf_state.redis.counters import Counters
from regnf_state.redis.fair_queue import FairQueue
from regnf_state.redis.webhook_outbox import RedisOutbox

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
        counters = Counters(services.redis)
        yield from fairness_metrics(FairQueue(services.redis), counters)
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
