"""What a caller may do how often and how much, and what it is told beyond that."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import pytest

from regnf_service.http.rate_limits import RateLimiter
from regnf_service.problem import Problem
from regnf_service.server import create_app
from regnf_state.redis.client import connect
from regnf_state.settings import Settings
from tests.contract.asgi import client_of
from tests.contract.world import ALICE, BOB, TOKENS, World, assert_refused, field_bytes, sha256
from tests.stores import stores_over


def put(client: httpx.Client, name: str, size: int = 600, **headers: str) -> httpx.Response:
    data = field_bytes(name, size)
    return client.put(f"/fields/{sha256(data)}", content=data, headers=headers)


# rates


def test_a_bucket_empties_and_fills(redis_url: str) -> None:
    with connect(redis_url) as redis:
        redis.flushall()
        slow, fast = RateLimiter(redis, 0.01, 3), RateLimiter(redis, 1e6, 1)
        assert [slow.take("alice") for _ in range(3)] == [0.0, 0.0, 0.0]
        assert 90 < slow.take("alice") <= 100
        assert slow.take("bob") == 0.0
        assert [fast.take("carol") for _ in range(20)] == [0.0] * 20
        # a minute ago there were none left: what has come in since is rate times a minute
        redis.hset("regnf:rate:alice", mapping={"tokens": "0.5", "at": f"{redis.time()[0] - 60}"})
        assert slow.take("alice") == 0.0
        assert 0.05 < float(redis.hget("regnf:rate:alice", "tokens")) < 0.15  # type: ignore[arg-type]
        assert 0 < redis.ttl("regnf:rate:alice") <= 301  # type: ignore[operator]


def test_calls_at_once_take_no_more_than_there_are(redis_url: str) -> None:
    with connect(redis_url) as redis, ThreadPoolExecutor(8) as pool:
        redis.flushall()
        limiter = RateLimiter(redis, 0.001, 10)
        assert sum(wait == 0 for wait in pool.map(limiter.take, ["alice"] * 40)) == 10


def test_one_callers_haste_is_not_anothers(tmp_path: Path, redis_url: str) -> None:
    with connect(redis_url) as redis:
        redis.flushall()
        settings = Settings(state_dir=tmp_path, api_tokens=TOKENS)
        app = create_app(settings, stores_over(redis, tmp_path / "blobs"), limiter=RateLimiter(redis, 0.01, 2))
        with client_of(app) as client:
            assert [client.get("/jobs", headers=ALICE).status_code for _ in range(2)] == [200, 200]
            refused = client.get("/jobs", headers=ALICE)
            assert_refused(refused, 429, "RATE_LIMITED")
            assert 90 < int(refused.headers["retry-after"]) <= 100
            assert client.get("/jobs", headers=BOB).status_code == 200
            assert client.get("/healthz").status_code == client.get("/static/js/app.js").status_code == 200
            assert_refused(client.get("/jobs"), 401, "UNAUTHENTICATED")


@pytest.mark.parametrize(
    ("host", "given", "rate"),
    [("127.0.0.1", None, 0), ("localhost", None, 0), ("0.0.0.0", None, 20), ("127.0.0.1", 5, 5), ("0.0.0.0", 0, 0)],
)
def test_without_a_word_there_is_no_rate_on_loopback(host: str, given: float | None, rate: float) -> None:
    assert Settings(host=host, quota_calls_per_s=given).calls_per_s == rate


# quotas


def test_active_jobs(worlds: Callable[..., World]) -> None:
    world = worlds(quota_active_jobs=2)
    first, _ = world.submit(seed=1), world.submit(seed=2)
    refused = world.client.post("/register", json=world.valid_request() | {"seed": 3})
    assert_refused(refused, 429, "QUOTA_ACTIVE_JOBS")
    assert int(refused.headers["retry-after"]) > 0
    assert world.client.post("/register", json=world.valid_request() | {"seed": 1}).status_code == 202, "known already"
    world.succeed(first)
    world.submit(seed=3)


def test_fields(worlds: Callable[..., World]) -> None:
    world = worlds(quota_fields=2, api_tokens=TOKENS)
    world.client.headers.update(ALICE)
    assert [put(world.client, name).status_code for name in "ab"] == [201, 201]
    assert_refused(put(world.client, "c"), 403, "QUOTA_STORED")
    assert_refused(world.client.post("/fields", content=field_bytes("c")), 403, "QUOTA_STORED")
    assert not [key for key in world.blobs.blobs if sha256(field_bytes("c")) in key], "nothing stays"
    assert put(world.client, "a").status_code == 200
    assert put(world.client, "c", **BOB).status_code == 201, "another caller's room is its own"
    world.client.delete(f"/fields/{sha256(field_bytes('b'))}")
    assert put(world.client, "c").status_code == 201


def test_stored_bytes(worlds: Callable[..., World]) -> None:
    world = worlds(quota_stored_bytes=2000)
    assert put(world.client, "a", 1500).status_code == 201
    assert_refused(put(world.client, "b", 501), 403, "QUOTA_STORED")
    assert_refused(world.client.post("/fields", content=field_bytes("b", 501)), 403, "QUOTA_STORED")
    assert put(world.client, "b", 500).status_code == 201
    error = {"reason": "FIELD_SHAPES_MISMATCH", "title": "", "status": 422, "detail": ""}
    world.records.update_field(sha256(field_bytes("a", 1500)), state="rejected", error=error)
    assert put(world.client, "c", 1500).status_code == 201, "the bytes of a rejected field were dropped"


def test_a_field_that_grew_counts_as_what_it_became(worlds: Callable[..., World]) -> None:
    world = worlds(quota_stored_bytes=2000)
    assert put(world.client, "a").status_code == 201
    name = sha256(field_bytes("a"))
    world.records.update_field(name, attempt=1, state="ready", report={"field_bytes": 1 << 31})
    assert world.client.get(f"/fields/{name}").json()["state"] == "ready", "it stays"
    assert_refused(put(world.client, "b"), 403, "QUOTA_STORED")
    assert_refused(world.client.post("/fields", content=field_bytes("b")), 403, "QUOTA_STORED")
    assert world.client.delete(f"/fields/{name}").status_code == 204
    assert put(world.client, "b").status_code == 201


def test_bytes_under_way_count_too(worlds: Callable[..., World]) -> None:
    world = worlds(quota_stored_bytes=3000, api_tokens=TOKENS)
    services = world.app.state.services
    alice, data = ALICE | {"Content-Type": "application/octet-stream"}, field_bytes("c", 1001)
    files = {"scene": ("s", field_bytes("s", 601)), "object": ("o", field_bytes("o")), "request": (None, "{}")}
    assert put(world.client, "a", 1000, **ALICE).status_code == 201
    with services.under_way.claim("alice", 2000, 500) as claim:
        claim.arrive(800)
        assert put(world.client, "b", 1200, **ALICE).status_code == 201, "its own bytes count once"
        world.client.delete(f"/fields/{sha256(field_bytes('b', 1200))}", headers=ALICE)
        assert_refused(put(world.client, "b", 1201, **ALICE), 403, "QUOTA_STORED")
        assert put(world.client, "a", 1000, **ALICE).status_code == 200, (
            "bytes that are held are no more when sent again"
        )
        claim.arrive(200)
        in_pieces = world.client.post("/fields", content=iter([data[:600], data[600:]]), headers=alice)
        assert_refused(in_pieces, 403, "QUOTA_STORED")
        assert_refused(world.client.post("/fields", files={"file": data}, headers=ALICE), 403, "QUOTA_STORED")
        assert_refused(world.client.post("/register", files=files, headers=ALICE), 403, "QUOTA_STORED")
        assert put(world.client, "b", 3000, **BOB).status_code == 201, "another caller's uploads are its own"
        with pytest.raises(Problem, match="Quota of storage"):
            claim.arrive(1001)
    assert put(world.client, "b", 2000, **ALICE).status_code == 201
    with services.under_way.claim("alice", 0, 0):
        pass
    with services.under_way.claim("alice", 1, 1), pytest.raises(Problem, match="Quota of storage"):
        services.under_way.claim("alice", 1, 1).__enter__()


def test_without_a_quota_uploads_under_way_are_not_bounded(worlds: Callable[..., World]) -> None:
    world = worlds(api_tokens=TOKENS)
    with world.app.state.services.under_way.claim("alice", None, 1 << 50):
        assert put(world.client, "a", **ALICE).status_code == 201


# at once


def test_uploads_at_once(worlds: Callable[..., World]) -> None:
    world = worlds(max_uploads_per_caller=2, api_tokens=TOKENS)
    uploads = world.app.state.services.uploads
    with uploads.held("alice"):
        assert put(world.client, "a", **ALICE).status_code == 201
        with uploads.held("alice"):
            refused = put(world.client, "b", **ALICE)
            assert_refused(refused, 429, "TOO_MANY_REQUESTS_AT_ONCE")
            assert int(refused.headers["retry-after"]) > 0
            assert put(world.client, "b", **BOB).status_code == 201
    odd = world.client.put("/fields/" + "0" * 64, content=b"x" * 600, headers=ALICE)
    assert_refused(odd, 415, "FIELD_NOT_RECOGNIZED")
    assert uploads.taken == 0, "places are given back, by a refused upload too"


def test_without_tokens_each_address_has_its_own_uploads(worlds: Callable[..., World]) -> None:
    world = worlds(max_uploads_per_caller=2)
    uploads = world.app.state.services.uploads
    with uploads.held("anonymous 127.0.0.2", 2):
        assert put(world.client, "a").status_code == 201
    with uploads.held("anonymous 127.0.0.1", 2):
        assert_refused(put(world.client, "b"), 429, "TOO_MANY_REQUESTS_AT_ONCE")


def test_streams_at_once(worlds: Callable[..., World]) -> None:
    world = worlds(max_streams_per_caller=1)
    job_id = world.submit()
    services = world.app.state.services
    with services.streams.held("anonymous"):
        assert_refused(world.client.get(f"/jobs/{job_id}/events"), 429, "TOO_MANY_REQUESTS_AT_ONCE")
    world.succeed(job_id)
    for _ in range(2):
        assert world.client.get(f"/jobs/{job_id}/events").status_code == 200
    assert services.streams.taken == services.uploads.taken == 0
