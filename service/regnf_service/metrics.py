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
    waiting = _by_caller("waiting", "Waiting jobs and imports, by caller.")
    oldest = _by_caller("wait_seconds", "Waiting time of the oldest one.")
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
    "job_attempts": ("Number of job attempts that were given to workers.", ()),
    "jobs_finished": ("Ended jobs.", ("status", "verdict", "reason")),
    "imports": ("Ended imports.", ("state", "reason")),
    "jobs_evicted": ("Finished jobs that were deleted early to free space.", ()),
    "records_unreadable": ("Unreadable records, by kind.", ("kind",)),
    "queue_payloads_refused": ("Queue entries that this service did not write.", ("queue",)),
    "webhook_sends": ("Webhook messages, by outcome.", ("outcome",)),
}
_TIMES = {
    "job_wait_seconds": ("Time from the acceptance of a job to its start.", ()),
    "job_run_seconds": ("Time from the start of a job to its end.", ("status",)),
    "job_phase_seconds": ("Time of a phase.", ("phase",)),
    "import_seconds": ("Time from an upload to the end of its import, including waiting.", ()),
}


class Metrics:
    """The registry of one application. Routes are counted by their templates, never by the ids in them."""

    def __init__(self, services: Services) -> None:
        self.registry = CollectorRegistry()
        self.requests = Counter(
            "regnf_http_requests", "Requests answered.", ("method", "route", "status"), registry=self.registry
        )
        self.seconds = Histogram(
            "regnf_http_request_seconds", "Time until the response began.", ("route",), registry=self.registry
        )
        self.received = Counter("regnf_received_bytes", "Size of bodies.", ("route",), registry=self.registry)
        self.redis_errors = Counter(
            "regnf_redis_errors", "Responses and scrapes without Redis.", registry=self.registry
        )
        ProcessCollector(registry=self.registry)
        self.quota_refusals = Counter(
            "regnf_quota_refusals",
            "Calls refused because of a quota of the caller.",
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
        yield _gauge("uploads_active", "Uploads in progress.", services.uploads.taken)
        yield _gauge("streams_active", "Open event streams.", services.streams.taken)
        try:
            held = list(self._ask())
        except RedisError:
            self._metrics.redis_errors.inc()
            yield _gauge("redis_up", "Whether Redis responded to this scrape.", 0)
            return
        yield _gauge("redis_up", "Whether Redis responded to this scrape.", 1)
        yield from held

    def _ask(self) -> Iterator[Metric]:
        services = self._services
        active = services.records.active_jobs()
        yield _gauge("queue_depth", "Jobs waiting for a worker.", sum(job.status == "accepted" for job in active))
        jobs = GaugeMetricFamily("regnf_jobs_active", "Jobs waiting or running.", labels=("status", "phase"))
        for labels, count in sorted(Tally((job.status, job.phase or "") for job in active).items()):
            jobs.add_metric(labels, count)
        yield jobs
        imports = len(services.records.validating_fields())
        yield _gauge("imports_active", "Imports waiting or running.", imports)
        yield _gauge(
            "unfinished", "Jobs and imports waiting or running: the load of the workers.", len(active) + imports
        )
        yield _gauge("workers", "Workers with a recent heartbeat.", services.queue.live_workers())
        yield _gauge("webhooks_waiting", "Messages that are not sent yet.", RedisOutbox(services.redis).waiting())
        yield _gauge("records_set_aside", "Unreadable records.", services.records.unreadable.total())
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
