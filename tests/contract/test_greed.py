"""What one caller may ask of the workers, so that others come to their turn."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import httpx
import pytest

from regnf_state.ownership import reference_of
from regnf_state.reasons import problem_document
from regnf_state.records import FieldRecord
from tests.contract.asgi import client_of
from tests.contract.world import BOX, World, assert_refused, field_bytes, sha256

TOKENS = frozenset({"greedy:the-greedy-one-s-token", "honest:the-honest-one-s-token"})
HONEST = {"Authorization": "Bearer the-honest-one-s-token"}


@pytest.fixture
def shared(worlds: Callable[..., World]) -> Callable[..., World]:
    """Makes a service of two callers; its client is the greedy one's."""

    def make(**settings: object) -> World:
        made = worlds(api_tokens=TOKENS, **settings)
        made.client.headers.update({"Authorization": "Bearer the-greedy-one-s-token"})
        return made

    return make


def put(client: httpx.Client, name: str) -> httpx.Response:
    data = field_bytes(name)
    return client.put(f"/fields/{sha256(data)}", content=data)


def imported(world: World, client: httpx.Client, caller: str) -> dict[str, Any]:
    names = []
    for name in ("scene", "object"):
        assert put(client, name).status_code == 201
        names.append(sha256(field_bytes(name)))
        world.records.update_field(reference_of(caller, names[-1]), attempt=1, state="ready")
    return {"scene": names[0], "object": names[1], "detection": BOX}


def accepted(client: httpx.Client, request: dict[str, Any], tries: int) -> int:
    """How many of so many registrations are taken before one is refused for the quota."""
    for seed in range(tries):
        answer = client.post("/register", json=request | {"seed": seed})
        if answer.status_code != 202:
            assert_refused(answer, 429, "QUOTA_ACTIVE_JOBS")
            assert int(answer.headers["Retry-After"]) >= 1
            return seed
    return tries


def test_imports_that_wait_are_bounded_for_each_caller(shared: Callable[..., World]) -> None:
    world = shared()
    answers = [put(world.client, str(number)) for number in range(100)]
    assert [answer.status_code for answer in answers] == [201] * 64 + [429] * 36
    assert_refused(answers[-1], 429, "QUOTA_ACTIVE_JOBS")
    assert int(answers[-1].headers["Retry-After"]) >= 1
    assert len(list(world.blobs.list("fields"))) == 64
    with client_of(world.app, headers=HONEST) as honest:
        assert put(honest, "0").status_code == 201
    assert put(world.client, "0").status_code == 200, "one that is held already asks for nothing"
    world.records.update_field(reference_of("greedy", sha256(field_bytes("7"))), attempt=1, state="ready")
    assert put(world.client, "200").status_code == 201
    assert world.client.delete(f"/fields/{sha256(field_bytes('8'))}").status_code == 204
    assert put(world.client, "201").status_code == 201
    assert put(world.client, "202").status_code == 429


def test_no_caller_has_more_jobs_than_it_leaves_free(shared: Callable[..., World]) -> None:
    world = shared(max_queued_jobs=12)
    with client_of(world.app, headers=HONEST) as honest:
        requests = imported(world, world.client, "greedy"), imported(world, honest, "honest")
        assert accepted(world.client, requests[0], 20) == 6
        assert accepted(honest, requests[1], 20) == 3
        assert accepted(world.client, requests[0] | {"seed": 100}, 0) == 0


def test_a_number_of_jobs_that_was_set_holds_instead(shared: Callable[..., World]) -> None:
    world = shared(max_queued_jobs=12, quota_active_jobs=10)
    assert accepted(world.client, imported(world, world.client, "greedy"), 20) == 10


def test_a_service_without_tokens_has_one_caller_who_may_have_all(worlds: Callable[..., World]) -> None:
    world = worlds(max_queued_jobs=30)
    request = world.valid_request()
    answers = [world.client.post("/register", json=request | {"seed": seed}) for seed in range(31)]
    assert [answer.status_code for answer in answers] == [202] * 30 + [503]
    assert answers[-1].json()["reason"] == "QUEUE_FULL"


def reject(world: World, caller: str, name: str, reason: str) -> None:
    """What a worker does with an upload that the gate refuses."""
    assert put(world.client, name).json()["state"] == "validating"
    field = world.records.get_field(reference_of(caller, sha256(field_bytes(name))))
    assert field is not None
    error = problem_document(reason)
    world.records.remember_rejection(field, error)
    world.blobs.delete_prefix(f"fields/{field.sha256}")
    world.records.update_field(field.sha256, attempt=field.attempt, state="rejected", error=error)
    world.queue.lose()


@pytest.mark.parametrize("delete", [False, True])
def test_bytes_that_were_rejected_are_not_imported_again(shared: Callable[..., World], delete: bool) -> None:
    world = shared()
    reject(world, "greedy", "bad", "FIELD_SHAPES_MISMATCH")
    path = f"/fields/{sha256(field_bytes('bad'))}"
    before = world.client.get(path).json()
    if delete:
        assert world.client.delete(path).status_code == 204
    for _ in range(3):
        answer = put(world.client, "bad")
        assert (answer.status_code, answer.json()["state"]) == (201, "rejected")
        assert answer.json()["error"] == before["error"]
    assert world.queue.imports == []
    assert list(world.blobs.list("fields")) == []
    with client_of(world.app, headers=HONEST) as honest:
        assert put(honest, "bad").json()["state"] == "validating", "nothing tells what another has sent"


@pytest.mark.parametrize(
    ("reason", "seconds"),
    [
        ("FIELD_SHAPES_MISMATCH", 86400),
        ("IMPORT_TOO_COSTLY", None),
        ("STORAGE_FULL", None),
        ("OUT_OF_MEMORY", None),
        ("WORKER_LOST", None),
        ("INTERNAL", None),
        ("A_REASON_OF_A_LATER_RELEASE", None),
    ],
)
def test_how_long_a_rejection_holds(shared: Callable[..., World], reason: str, seconds: int | None) -> None:
    world = shared()
    reject(world, "greedy", "bad", reason)
    keys = world.redis.keys("regnf:rejection:*")
    assert [world.redis.ttl(key) for key in keys] == ([] if seconds is None else [pytest.approx(seconds, abs=30)])
    assert put(world.client, "bad").json()["state"] == ("validating" if seconds is None else "rejected")


def test_another_description_is_another_upload(shared: Callable[..., World]) -> None:
    world = shared()
    reject(world, "greedy", "bad", "FIELD_SHAPES_MISMATCH")
    parts = {"file": field_bytes("bad"), "description": ("", json.dumps({"family": "grid"}), "application/json")}
    answer = world.client.post("/fields", files=parts)
    assert (answer.status_code, answer.json()["state"]) == (201, "validating"), answer.text


def test_rejections_that_are_kept_are_bounded(shared: Callable[..., World]) -> None:
    world = shared()
    fields = [FieldRecord(f"{number:064x}_greedy", "validating", 1, 0.0, 0.0) for number in range(300)]
    for field in fields:
        world.records.remember_rejection(field, {"reason": "FIELD_SHAPES_MISMATCH"})
    assert len(world.redis.keys("regnf:rejection:*")) == 256
    assert [world.records.known_rejection(one) is not None for one in (fields[43], fields[44])] == [False, True]
