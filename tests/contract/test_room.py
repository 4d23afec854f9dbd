"""Greedy callers over HTTP: Redis stays within its memory, and everybody else is served."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from redis import Redis

from regnf_state.redis.client import connect
from regnf_state.room import Room
from tests.contract.world import BOX, World, assert_refused, field_bytes, make_world, sha256
from tests.redis_server import private_redis

TOKENS = {"greedy": {"Authorization": "Bearer greedy-token"}, "honest": {"Authorization": "Bearer honest-token"}}
_ROOM = 3 * 512 * 1024


@pytest.fixture
def redis() -> Iterator[Redis]:
    with private_redis() as url, connect(url) as made:
        yield made


def served(folder: Path, redis: Redis, **settings: Any) -> World:
    """No rate of writes protects Redis here: its own bounds have to."""
    callers = frozenset({"greedy:greedy-token", "honest:honest-token"})
    return make_world(folder, redis, api_tokens=callers, **settings)


def ready(world: World, caller: str) -> dict[str, Any]:
    names = {}
    for role in ("scene", "object"):
        data = field_bytes(role)
        world.client.put(f"/fields/{sha256(data)}", content=data, headers=TOKENS[caller]).raise_for_status()
        names[role] = sha256(data)
    return {**names, "detection": BOX}


def register(world: World, caller: str, request: dict[str, Any], seed: int, **headers: str) -> Any:
    return world.client.post("/register", json=request | {"seed": seed}, headers=TOKENS[caller] | headers)


def register_and_cancel(world: World, caller: str, request: dict[str, Any], seed: int) -> int:
    answer = register(world, caller, request, seed)
    if answer.status_code == 202:
        done = world.client.post(f"/jobs/{answer.json()['id']}/cancel", headers=TOKENS[caller])
        assert done.status_code == 202, done.text
    return int(answer.status_code)


def limit(redis: Redis, room: int) -> None:
    redis.config_set("maxmemory", redis.info("memory")["used_memory"] + room)  # type: ignore[index]


def test_a_caller_who_registers_and_cancels_stops_nobody(tmp_path: Path, redis: Redis) -> None:
    """Without bounds some hundred and fifty pairs fill this room; then nobody writes for seven days."""
    world = served(tmp_path, redis, max_upload_bytes=4096)
    with world.client:
        requests = {caller: ready(world, caller) for caller in TOKENS}
        first = register(world, "honest", requests["honest"], 0).json()["id"]
        world.succeed(first)
        limit(redis, _ROOM)
        for seed in range(250):
            register_and_cancel(world, "greedy", requests["greedy"], seed)
        answer = register(world, "honest", requests["honest"], 1)
        assert answer.status_code == 202, answer.text
        assert world.client.post(f"/jobs/{answer.json()['id']}/cancel", headers=TOKENS["honest"]).status_code == 202
        assert world.client.delete(f"/jobs/{answer.json()['id']}", headers=TOKENS["honest"]).status_code == 204
        assert world.client.get("/readyz", headers=TOKENS["honest"]).status_code == 200
        assert world.client.get(f"/jobs/{first}/result", headers=TOKENS["honest"]).status_code == 200
        memory = redis.info("memory")
        assert memory["used_memory"] < memory["maxmemory"]  # type: ignore[index]


def test_a_reserve_is_kept_for_what_goes_on(tmp_path: Path, redis: Redis) -> None:
    """Waiting jobs are not evicted: new ones of the greedy caller are refused, everything else goes on."""
    world = served(tmp_path, redis, max_upload_bytes=4096, max_queued_jobs=100_000)
    with world.client:
        requests = {caller: ready(world, caller) for caller in TOKENS}
        running = register(world, "honest", requests["honest"], 0).json()["id"]
        world.run(running)
        limit(redis, _ROOM)
        answers = [register(world, "greedy", requests["greedy"], seed) for seed in range(350)]
        refused = [answer for answer in answers if answer.status_code != 202]
        assert refused
        for answer in refused:
            assert_refused(answer, 507, "STORAGE_FULL")
            assert "retry-after" in answer.headers
        answer = register(world, "honest", requests["honest"], 1)
        assert answer.status_code == 202, answer.text
        world.records.heartbeat(running, 1)
        world.records.update_job(running, 1, status="successful")
        waiting = answers[0].json()["id"]
        assert world.client.post(f"/jobs/{waiting}/cancel", headers=TOKENS["greedy"]).status_code == 202
        assert world.client.delete(f"/jobs/{waiting}", headers=TOKENS["greedy"]).status_code == 204
        redis.config_set("maxmemory", 1)
        problem = assert_refused(world.client.get("/readyz", headers=TOKENS["honest"]), 503, "NOT_READY")
        assert problem["reasons"] == {"records": "STORAGE_FULL"}
        assert_refused(register(world, "honest", requests["honest"], 2), 507, "STORAGE_FULL")


def test_a_caller_s_oldest_finished_jobs_go_beyond_its_quota(tmp_path: Path, redis: Redis) -> None:
    world = served(tmp_path, redis, max_upload_bytes=4096, quota_finished_jobs=3)
    with world.client:
        requests = {caller: ready(world, caller) for caller in TOKENS}
        honest = register(world, "honest", requests["honest"], 0).json()["id"]
        world.succeed(honest)
        jobs = []
        for seed in range(6):
            jobs.append(register(world, "greedy", requests["greedy"], seed).json()["id"])
            world.succeed(jobs[-1])
        listed = world.client.get("/jobs", headers=TOKENS["greedy"]).json()["jobs"]
        assert [job["id"] for job in listed] == jobs[:2:-1]
        assert_refused(world.client.get(f"/jobs/{jobs[0]}", headers=TOKENS["greedy"]), 410, "JOB_EXPIRED")
        assert_refused(world.client.get(f"/jobs/{jobs[0]}", headers=TOKENS["honest"]), 404, "JOB_NOT_FOUND")
        assert list(world.blobs.list(f"jobs/{jobs[0]}")) == list(world.blobs.list(f"journal/jobs/{jobs[0]}")) == []
        assert world.client.get(f"/jobs/{honest}/result", headers=TOKENS["honest"]).status_code == 200
        again = register(world, "greedy", requests["greedy"], 0)
        assert (again.status_code, again.json()["id"]) == (202, jobs[0])


def test_rounds_bring_all_callers_within_their_bounds(tmp_path: Path, redis: Redis) -> None:
    world = served(tmp_path, redis, max_upload_bytes=4096)
    with world.client:
        requests = {caller: ready(world, caller) for caller in TOKENS}
        for caller, count in (("greedy", 6), ("honest", 2)):
            for seed in range(count):
                register_and_cancel(world, caller, requests[caller], seed)
        room = Room(world.records, world.blobs, redis, world.settings.model_copy(update={"max_finished_jobs": 5}))
        assert room.tidy(lambda: None) == 3
        held = [len(world.client.get("/jobs", headers=TOKENS[caller]).json()["jobs"]) for caller in TOKENS]
        assert held == [3, 2], "of whoever has most"


def test_idempotency_keys_and_attempts_of_deleted_fields_are_bounded(
    tmp_path: Path, redis: Redis, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("regnf_state.redis.counters.SHORT_LIVED", 5)
    world = served(tmp_path, redis, max_upload_bytes=4096)
    with world.client:
        request = ready(world, "greedy")
        register(world, "honest", ready(world, "honest"), 0, **{"Idempotency-Key": "mine"})
        for number in range(20):
            register(world, "greedy", request, 0, **{"Idempotency-Key": f"key-{number}"})
            data = field_bytes(f"field {number}")
            world.client.put(f"/fields/{sha256(data)}", content=data, headers=TOKENS["greedy"])
            world.client.delete(f"/fields/{sha256(data)}", headers=TOKENS["greedy"])
        assert len(redis.keys("regnf:once:idempotency:*")) == 5 + 1
        assert len(redis.keys("regnf:field:*:attempts")) == 5


def test_rejected_fields_are_bounded(tmp_path: Path, redis: Redis, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("regnf_state.room._REJECTED_KEPT", 3)
    world = make_world(tmp_path, redis)
    with world.client:
        names = [world.rejected_field(f"field {number}") for number in range(6)]
        world.ready_field("last")
        left = {field["sha256"] for field in world.client.get("/fields").json()["fields"] if field["error"]}
        assert left == set(names[-3:])


def test_a_job_that_is_asked_for_again_and_again_does_not_grow(tmp_path: Path, redis: Redis) -> None:
    world = served(tmp_path, redis, max_upload_bytes=4096)
    with world.client:
        request = ready(world, "greedy")
        for _ in range(30):
            register_and_cancel(world, "greedy", request, 0)
        (job,) = world.client.get("/jobs", headers=TOKENS["greedy"]).json()["jobs"]
        assert job["attempts"] == 30
        assert len(list(world.blobs.list(f"journal/jobs/{job['id']}"))) == 2
        assert redis.xlen(f"regnf:job:{job['id']}:events") <= 8
