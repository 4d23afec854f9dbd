"""What Prometheus scrapes: requests of this process, and what Redis knows of jobs, imports, workers and webhooks."""

from __future__ import annotations

from collections import Counter as Tally
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from prometheus_client import CollectorRegistry, Counter, Histogram, ProcessCollector, start_http_server
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector
from redis.exceptions import RedisError
from starlette.types import Scope

from regnf_service.http.middleware import route_of
from regnf_service.services import Services
from regnf_state.redis.counters import Counters
from regnf_state.redis.fair_queue import FairQueue
from regnf_state.redis.webhook_outbox import RedisOutbox

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

    def __init__(self, services: Services) -> None:
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
        ProcessCollector(registry=self.registry)
        self.quota_refusals = Counter(
            "regnf_quota_refusals",
            "Calls refused because of what their caller has.",
            ("reason",),
            registry=self.registry,
        )
        self.registry.register(_Held(self, services))

    def count(self, scope: Scope, status: int, seconds: float, received: int) -> None:
        """One request. seconds: until its answer began · received: bytes of its body."""
        route, method = route_of(scope), scope["method"]
        known = method if method in ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE") else "other"
        self.requests.labels(known, route, str(status)).inc()
        self.seconds.labels(route).observe(seconds)
        if received:
            self.received.labels(route).inc(received)


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


@contextmanager
def served(registry: CollectorRegistry, address: str | None) -> Iterator[None]:
    """Answer scrapes at `host:port` while the context lasts, whoever asks; no address: not at all."""
    if address is None:
        yield
        return
    host, _, port = address.rpartition(":")
    server, thread = start_http_server(int(port), host.strip("[]"), registry)
    try:
        yield
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
