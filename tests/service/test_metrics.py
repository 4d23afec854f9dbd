"""Metrics: what is counted, once, and shown on a port of its own."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families
from redis import Redis

from regnf_service.metrics import Metrics, served
from regnf_state.records import FieldRecord, JobRecord
from regnf_state.redis.client import connect
from regnf_state.redis.counters import BOUNDS_S, Counters
from regnf_state.redis.jobs import RecordStore
from regnf_state.settings import Settings
from tests.contract.world import assert_refused, make_world
from tests.redis_server import private_redis
from tests.stores import WatchedQueue, services_over

SHA = "a" * 64


@pytest.fixture
def redis(redis_url: str) -> Iterator[Redis]:
    with connect(redis_url, retries=0) as made:
        made.flushall()
        yield made


def values(text: str) -> dict[tuple[str, ...], float]:
    samples = (sample for family in text_string_to_metric_families(text) for sample in family.samples)
    return {(one.name, *(value for _, value in sorted(one.labels.items()))): one.value for one in samples}


def scrape(metrics: Metrics) -> dict[tuple[str, ...], float]:
    from prometheus_client import generate_latest

    return values(generate_latest(metrics.registry).decode())


def metrics_of(redis: Redis, folder: Path) -> tuple[RecordStore, Metrics]:
    services = services_over(redis, Settings(state_dir=folder))
    assert isinstance(services.queue, WatchedQueue)
    services.queue.workers = None  # those that have reported are counted
    return services.records, Metrics(services)


def job(store: RecordStore, name: str) -> JobRecord:
    return store.create_job(JobRecord(name, "registration", "accepted", {}, {}, store.now(), store.now()), 10)[0]


def test_a_jobs_way_is_counted_once(redis: Redis, tmp_path: Path) -> None:
    store, metrics = metrics_of(redis, tmp_path)
    for name in ("good", "bad", "waiting"):
        job(store, name)
    store.update_job("good", 1, status="running", phase="loading")
    now = scrape(metrics)
    assert now["regnf_jobs_active", "loading", "running"] == 1
    assert now["regnf_jobs_active", "", "accepted"] == now["regnf_queue_depth",] == 2
    store.update_job("good", 1, phase="optimizing", progress=0.5)
    for _ in range(3):
        store.update_job("good", 1, progress=0.6)
    store.update_job("good", 1, status="successful", verdict="ambiguous")
    store.update_job("bad", 1, status="running")
    store.requeue_job("bad", 1)
    store.update_job("bad", 2, status="failed", error={"reason": "WORKER_LOST"})
    now = scrape(metrics)
    assert now["regnf_jobs_finished_total", "", "successful", "ambiguous"] == 1
    assert now["regnf_jobs_finished_total", "WORKER_LOST", "failed", ""] == 1
    assert now["regnf_job_attempts_total",] == 4
    assert now["regnf_job_wait_seconds_count",] == 2
    assert now["regnf_job_phase_seconds_count", "loading"] == now["regnf_job_phase_seconds_count", "optimizing"] == 1
    assert now["regnf_job_run_seconds_count", "successful"] == 1
    assert now["regnf_job_run_seconds_sum", "successful"] < 60
    assert now["regnf_workers",] == 0
    assert now["regnf_unfinished",] == 1
    assert now["regnf_redis_up",] == 1


def test_seconds_go_into_the_buckets_of_their_bounds(redis: Redis) -> None:
    from regnf_state.redis.counters import timed

    for seconds in (0.05, 0.1, 0.2, 2.0, 5000.0, -3.0):
        for command in timed("job_wait_seconds", seconds):
            redis.execute_command(*command)
    ((labels, buckets, total),) = Counters(redis).times("job_wait_seconds")
    assert (labels, total) == ((), pytest.approx(5002.35))
    assert dict(buckets)["0.1"] == 3
    assert dict(buckets)["0.3"] == 4
    assert dict(buckets)[str(BOUNDS_S[-1])] == 5
    assert dict(buckets)["+Inf"] == 6


def test_the_time_in_a_phase_begins_with_it(redis: Redis) -> None:
    store = RecordStore(redis)
    job(store, "j")
    began = store.update_job("j", 1, status="running", phase="loading")
    later = store.update_job("j", 1, progress=0.4)
    assert later.phase_since == began.phase_since == began.updated
    assert store.update_job("j", 1, phase="sampling").phase_since > began.phase_since  # type: ignore[operator]


def test_imports_by_reason(redis: Redis, tmp_path: Path) -> None:
    store, metrics = metrics_of(redis, tmp_path)
    for digit, state, error in (("1", "ready", None), ("2", "rejected", {"reason": "FIELD_SHAPES_MISMATCH"})):
        store.create_field(FieldRecord(digit * 64, "validating", 1, store.now(), store.now()))
        store.update_field(digit * 64, state=state, error=error)
    store.update_field("1" * 64, label="room")
    store.create_field(FieldRecord("3" * 64, "validating", 1, store.now(), store.now()))
    now = scrape(metrics)
    assert now["regnf_imports_total", "", "ready"] == 1
    assert now["regnf_imports_total", "FIELD_SHAPES_MISMATCH", "rejected"] == 1
    assert (now["regnf_imports_active",], now["regnf_import_seconds_count",], now["regnf_unfinished",]) == (1, 2, 1)


def test_requests_by_route_never_by_id(tmp_path: Path, any_redis: Redis) -> None:
    world = make_world(tmp_path, any_redis)
    with world.client as client:
        for path in (f"/fields/{SHA}", f"/fields/{'b' * 64}", f"/v1/fields/{SHA}", "/nowhere/at/all", "/healthz"):
            client.get(path)
        client.put(f"/fields/{SHA}", content=b"x" * 600)
        client.request("BREW", "/healthz")
        now = scrape(world.app.state.metrics)
        assert now["regnf_http_requests_total", "GET", "/fields/{sha256}", "404"] == 3
        assert now["regnf_http_requests_total", "GET", "other", "404"] == 1
        assert now["regnf_http_request_seconds_count", "/fields/{sha256}"] == 4
        assert now["regnf_received_bytes_total", "/fields/{sha256}"] == 600
        assert not [name for name in now if SHA in name]
        assert_refused(client.get("/metrics"), 404, "NOT_FOUND")


def test_a_scrape_without_redis_says_so(tmp_path: Path) -> None:
    with private_redis() as url:
        redis = connect(url, retries=0)
        _, metrics = metrics_of(redis, tmp_path)
        assert scrape(metrics)["regnf_redis_up",] == 1
    now = scrape(metrics)
    assert now["regnf_redis_up",] == 0
    assert ("regnf_queue_depth",) not in now
    assert scrape(metrics)["regnf_redis_errors_total",] >= 1
    redis.close()


def test_they_have_a_port_of_their_own(tmp_path: Path, any_redis: Redis) -> None:
    metrics = make_world(tmp_path, any_redis).app.state.metrics
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with served(metrics.registry, f"127.0.0.1:{port}"):
        answer = httpx.get(f"http://127.0.0.1:{port}/metrics")
        assert answer.headers["content-type"].startswith("text/plain")
        assert {("regnf_uploads_active",), ("process_open_fds",)} <= values(answer.text).keys()
    with pytest.raises(httpx.ConnectError):
        httpx.get(f"http://127.0.0.1:{port}/metrics")
    with served(metrics.registry, None):
        pass
