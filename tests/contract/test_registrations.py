"""POST /register: what becomes a job, and what was one already."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Sequence
from typing import Any

import pytest

from regnf_service.jobs.submit import job_id_of
from regnf_state.records import FieldRecord
from regnf_state.registration_request import RegistrationRequest
from tests.contract.world import BOX, World, assert_refused, field_bytes, put, sha256


def post(world: World, headers: dict[str, str] | None = None, **changes: Any) -> Any:
    return world.client.post("/register", json=world.valid_request() | changes, headers=headers)


def request_of(world: World, job_id: str) -> dict[str, Any]:
    return world.job(job_id).request


def jobs_of(world: World, spellings: Sequence[dict[str, Any]]) -> list[str]:
    return [str(post(world, **one).json()["id"]) for one in spellings]


def test_a_request_becomes_a_job_and_reaches_the_queue(world: World) -> None:
    answer = post(world, seed=7)
    assert answer.status_code == 202
    job = answer.json()
    assert answer.headers["location"] == f"/jobs/{job['id']}" == job["links"]["self"]
    assert answer.headers["retry-after"] == "1"
    assert (job["status"], job["queue_position"], job["attempts"]) == ("accepted", 1, 1)
    assert (job["inputs"]["seed"], job["inputs"]["scene"]) == (7, sha256(field_bytes("scene")))
    assert world.queue.registrations == [(job["id"], 1)]


def test_the_request_is_one_canonical_value_from_the_route_to_the_worker(world: World) -> None:
    asked = {"options": {"sampling": {"views": 9}}, "detection": BOX | {"label": "chair"}, "seed": 3}
    told = world.client.post("/register?dry_run=true", json=world.valid_request() | asked).json()
    job_id = post(world, **asked).json()["id"]
    held = request_of(world, job_id)
    detection = held["detection"]
    assert detection["rotation_quaternion_xyzw"] == [0.0, 0.0, 0.0, 1.0]
    assert [round(value, 9) for value in detection["center"] + detection["size"]] == [-0.15, -0.05, 0.2, 0.5, 0.5, 0.4]
    assert (detection["label"], detection["score"]) == ("chair", None)
    options = held["options"]
    assert [options["sampling"]["views"], options["optimization"]["iterations"], options["preset"]] == [
        9,
        200,
        "robust",
    ]
    assert (held["seed"], held["ground_truth"]) == (3, None)
    assert set(held) == {
        "scene", "object", "candidates", "detection", "options", "seed", "initial_transform", "ground_truth", "version",
    }  # fmt: skip
    read = RegistrationRequest.from_record(held)
    assert (read.to_record(), read.values()) == (held, told["request"])
    assert job_id_of(read) == told["id"] == job_id


def test_a_request_without_pictures_is_another_job(world: World) -> None:
    usual, said, without = (post(world, **more).json() for more in ({}, {"pictures": True}, {"pictures": False}))
    assert usual["id"] == said["id"] != without["id"]
    for job, pictures in ((usual, True), (without, False)):
        assert job["inputs"]["pictures"] is pictures
        assert RegistrationRequest.from_record(request_of(world, job["id"])).pictures is pictures
    assert_refused(post(world, pictures="no"), 422, "INVALID_REQUEST")


def test_two_spellings_of_one_request_are_one_job(world: World) -> None:
    scene = world.valid_request()["scene"]
    box: dict[str, Any] = {"center": [0, 0.25, 0.5], "size": [1, 1, 1]}
    spellings: list[dict[str, Any]] = [
        {"detection": box | {"label": "chair", "score": 0.5}},  # they make no other job, and the first stay
        {"detection": {"min": [-0.5, -0.25, 0.0], "max": [0.5, 0.75, 1.0]}, "seed": 0},
        {"scene": {"field": scene}, "detection": box | {"rotation_quaternion_xyzw": [0, 0, 0, -3]}},
        {"detection": box | {"label": None}, "options": {"optimization": {"iterations": 200}}},
        {"detection": box, "options": {"optimization": {"iterations": 200.0}}, "seed": 0.0, "initial_transform": None},
        {"detection": box | {"label": "a thing that no detector names", "score": 0.75}},
    ]
    ids = jobs_of(world, spellings)
    assert ids == ids[:1] * len(ids)
    assert world.queue.registrations == [(ids[0], 1)]
    kept = request_of(world, ids[0])["detection"]
    assert (kept["label"], kept["score"]) == ("chair", 0.5)


def test_two_spellings_of_one_start_are_one_job(world: World) -> None:
    turned = [[0, -2, 0, 0.5], [2, 0, 0, 0], [0, 0, 2, -1], [0, 0, 0, 1]]
    half = 0.5**0.5
    spelled = {"matrix": turned, "scale": 2, "translation": [0.5, 0, -1]}
    starts: list[Any] = [
        turned,
        {"matrix": [[float(value) or -0.0 for value in row] for row in turned]},
        spelled | {"rotation_quaternion_xyzw": [0, 0, half, half]},
        spelled | {"rotation_quaternion_xyzw": [0, 0, -3, -3]},
    ]
    ids = jobs_of(world, [{"initial_transform": start} for start in starts])
    assert ids == ids[:1] * len(ids)
    assert request_of(world, ids[0])["initial_transform"] == turned
    assert world.client.get(f"/jobs/{ids[0]}").json()["inputs"]["initial_transform"] == turned


def test_a_results_own_transform_is_a_start_and_a_truth(world: World) -> None:
    world.succeed(first := world.submit())
    found = world.client.get(f"/jobs/{first}/result").json()["T_object_scene"]
    answer = post(world, initial_transform=found, ground_truth={"T_object_scene": found})
    assert answer.status_code == 202, answer.text
    held = request_of(world, answer.json()["id"])
    assert held["initial_transform"] == found["matrix"] == held["ground_truth"]["T_object_scene"]


def library(world: World, *names: str) -> dict[str, Any]:
    request = world.valid_request()
    del request["object"]
    for name in names:
        if world.records.get_field(sha256(field_bytes(name))) is None:
            world.ready_field(name)
    return request | {"candidates": [sha256(field_bytes(name)) for name in names]}


def test_a_search_is_a_job_like_any_other(world: World) -> None:
    """Neither order nor spelling of its candidates says anything; others are another job, as is one object alone."""
    request = library(world, "chair", "table", "can")
    names = request["candidates"]
    answer = world.client.post("/register", json=request)
    assert answer.status_code == 202, answer.text
    job = answer.json()
    assert (job["inputs"]["object"], job["inputs"]["candidates"]) == (None, 3)
    held = request_of(world, job["id"])
    assert (held["object"], held["candidates"]) == (None, sorted(names))
    spelled = request | {"candidates": [{"field": sha} for sha in reversed(names)]}
    alone = {name: value for name, value in request.items() if name != "candidates"} | {"object": names[0]}
    others = [request | {"candidates": names[:2]}, request | {"candidates": names[:1]}, alone]
    ids = [world.client.post("/register", json=body).json()["id"] for body in (spelled, *others)]
    assert ids[0] == job["id"]
    assert len(set(ids)) == 4


@pytest.mark.parametrize("kind", ["one object", "a search"])
def test_a_job_that_has_ended_says_what_was_asked_for(world: World, kind: str) -> None:
    turned = [[0, -1, 0, 0.3], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    one = world.valid_request() | {"initial_transform": turned, "pictures": False}
    request = library(world, "chair", "table") if kind == "a search" else one
    request |= {"seed": 3, "options": {"up_axis": "y", "robust": {"rotations": 99}}}
    job = world.client.post("/register", json=request).json()
    address = f"/jobs/{job['id']}"
    world.records.update_job(job["id"], 1, status="failed", error={"reason": "NO_SURFACE_IN_DETECTION"})
    again = world.client.get(f"{address}/request").json()
    assert again["options"]["robust"]["rotations"] == 99
    assert world.client.delete(address).status_code == 204
    answer = world.client.post("/register", json=again)
    assert (answer.status_code, answer.json()["id"]) == (202, job["id"])


def test_as_many_candidates_as_are_allowed(world: World) -> None:
    request, names = library(world), [f"{number:064x}" for number in range(512)]
    for sha in names:
        world.records.restore_field(FieldRecord(sha, "validating", 600, 1.0, 1.0))
    assert world.client.post("/register", json=request | {"candidates": names}).status_code == 202


def test_candidates_are_in_use_while_the_job_is_active(world: World) -> None:
    request = library(world, "chair", "table")
    job_id = world.client.post("/register", json=request).json()["id"]
    for sha in request["candidates"]:
        assert_refused(world.client.delete(f"/fields/{sha}"), 409, "FIELD_IN_USE")
    world.client.post(f"/jobs/{job_id}/cancel")
    for sha in request["candidates"]:
        assert world.client.delete(f"/fields/{sha}").status_code == 204


def test_what_may_change_the_result_is_another_job(world: World) -> None:
    twice = [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]
    changes: list[dict[str, Any]] = [
        {}, {"seed": 1}, {"options": {"sampling": {"views": 6}}}, {"detection": BOX | {"max": [0.1, 0.3, 0.4]}},
        {"ground_truth": {"T_object_scene": twice}}, {"initial_transform": twice},
        {"scene": world.valid_request()["object"]},
    ]  # fmt: skip
    assert len(set(jobs_of(world, changes))) == len(changes)


def test_a_finished_job_is_the_answer_and_a_failed_one_is_started_anew(world: World) -> None:
    job_id = world.submit()
    world.queue.lose()
    assert post(world).status_code == 202
    assert world.queue.registrations == [(job_id, 1)], "it was never queued"
    world.fail(job_id, reason="NO_INITIAL_TRANSFORM")
    answer = post(world)
    assert (answer.status_code, answer.json()["attempts"], answer.json()["error"]) == (202, 2, None)
    assert world.queue.registrations[-1] == (job_id, 2)
    world.succeed(job_id)
    answer = post(world)
    assert (answer.status_code, answer.json()["status"]) == (200, "successful")
    assert "result" in answer.json()["links"]


def test_fields_that_are_still_validating_are_accepted(world: World) -> None:
    late = put(world.client, field_bytes("late")).json()["sha256"]
    assert post(world, object=late).status_code == 202


def test_prefer_wait_answers_once_the_job_has_finished_or_gives_up_in_time(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer = post(world, headers={"Prefer": "wait=1"})
    assert (answer.status_code, answer.json()["status"]) == (202, "accepted")
    queued, enqueue = threading.Event(), world.queue.enqueue_jobs
    monkeypatch.setattr(world.queue, "enqueue_jobs", lambda *given: (enqueue(*given), queued.set())[0])

    def finish() -> None:
        assert queued.wait(20)
        world.succeed(world.queue.registrations[-1][0])

    worker = threading.Thread(target=finish)
    worker.start()
    answer = post(world, headers={"Prefer": "respond-async, wait=20"}, seed=1)
    worker.join()
    assert (answer.status_code, answer.json()["status"]) == (200, "successful")
    assert answer.headers["preference-applied"] == "wait=20"


def test_a_dry_run_starts_nothing(world: World) -> None:
    answer = world.client.post("/register?dry_run=true", json=world.valid_request())
    assert answer.status_code == 200
    assert answer.json()["valid"] is True
    assert world.records.list_jobs(None, 10, None).records == []
    assert answer.json()["id"] == post(world).json()["id"]


def test_an_idempotency_key_belongs_to_one_request_and_returns_its_first_answer_even_of_a_failed_job(
    world: World,
) -> None:
    key = {"Idempotency-Key": "run-1"}
    job_id = post(world, headers=key).json()["id"]
    assert_refused(post(world, headers=key, seed=1), 422, "IDEMPOTENCY_KEY_REUSED")
    world.fail(job_id, reason="NO_INITIAL_TRANSFORM")
    again = post(world, headers=key)
    assert (again.status_code, again.json()["status"], again.json()["attempts"]) == (200, "failed", 1)
    assert post(world, headers={"Idempotency-Key": "run-2"}).json()["attempts"] == 2


def test_a_full_queue_says_when_to_come_back(worlds: Callable[..., World]) -> None:
    world = worlds(max_queued_jobs=1)
    first = world.submit()
    answer = post(world, seed=1)
    assert_refused(answer, 503, "QUEUE_FULL")
    assert int(answer.headers["retry-after"]) > 0
    assert post(world).json()["id"] == first
    world.succeed(first)
    assert post(world, seed=1).status_code == 202


def one_shot(scene: bytes, object_: bytes, question: dict[str, Any]) -> dict[str, Any]:
    return {
        "request": (None, json.dumps(question), "application/json"),
        "scene": ("scene.ckpt", scene),
        "object": ("object.ckpt", object_),
    }


def test_one_shot_uploads_both_fields_and_registers_them(world: World) -> None:
    scene, object_ = field_bytes("one"), field_bytes("two")
    answer = world.client.post("/register", files=one_shot(scene, object_, {"detection": BOX}))
    assert answer.status_code == 202, answer.text
    assert world.queue.imports == [(sha256(scene), 1), (sha256(object_), 1)]
    assert world.queue.registrations == [(answer.json()["id"], 1)]
    for sha, data in ((sha256(scene), scene), (sha256(object_), object_)):
        assert world.blobs.blobs[f"fields/{sha}/original"] == data
    by_reference = {"scene": sha256(scene), "object": sha256(object_), "detection": BOX}
    assert world.client.post("/register", json=by_reference).json()["id"] == answer.json()["id"]


def test_one_shot_keeps_nothing_of_a_request_that_is_refused_or_a_dry_run(world: World) -> None:
    one, two = field_bytes("one"), field_bytes("two")
    unknown = one_shot(one, two, {"detection": BOX, "options": {"unknown": 1}})
    assert_refused(world.client.post("/register", files=unknown), 422, "INVALID_OPTIONS")
    good = one_shot(one, two, {"detection": BOX})
    missing = {name: part for name, part in good.items() if name != "object"}
    assert_refused(world.client.post("/register", files=missing), 400, "MALFORMED_MULTIPART")
    assert world.client.post("/register?dry_run=true", files=good).json()["valid"] is True
    assert (world.blobs.blobs, world.records.list_fields(None, 10, None).records) == ({}, [])


_INTO_OBJECT = [[0.0, 2.0, 0.0, -2.0], [-2.0, 0.0, 0.0, 4.0], [0.0, 0.0, 2.0, -1.0], [0.0, 0.0, 0.0, 1.0]]
_INTO_SCENE = [[0.0, -0.5, 0.0, 2.0], [0.5, 0.0, 0.0, 1.0], [0.0, 0.0, 0.5, 0.5], [0.0, 0.0, 0.0, 1.0]]


@pytest.mark.parametrize("member", ["initial_transform", "ground_truth"])
def test_a_pose_may_be_said_in_either_direction(world: World, member: str) -> None:
    said = [
        {"T_object_scene": _INTO_OBJECT},
        {"T_scene_object": _INTO_SCENE},
        {"T_scene_object": {"matrix": _INTO_SCENE, "scale": 0.5}},
        *([_INTO_OBJECT, {"matrix": _INTO_OBJECT}] if member == "initial_transform" else []),
    ]
    requests = [world.valid_request() | {member: one} for one in said]
    asked = [world.client.post("/register?dry_run=true", json=one).json() for one in requests]
    meant: Any = _INTO_OBJECT if member == "initial_transform" else {"T_object_scene": _INTO_OBJECT}
    assert [one["request"][member] for one in asked] == [meant] * len(said)
    assert len({one["id"] for one in asked}) == 1
    lines = "\n".join(map(json.dumps, requests))
    answer = world.client.post("/batches", content=lines, headers={"Content-Type": "application/x-ndjson"})
    assert (answer.status_code, answer.json()["active"]) == (202, len(said)), answer.text
    assert [one["id"] for one in world.client.get("/jobs").json()["jobs"]] == [asked[0]["id"]]


def test_a_request_as_another_editor_saves_it(world: World) -> None:
    request = world.valid_request()
    plain = world.client.post("/register", json=request)
    text = json.dumps(request, indent=1).replace("\n", "\r\n")
    for encoding in ("utf-8-sig", "utf-16", "utf-16-be", "utf-32", "cp1252"):
        headers = {"Content-Type": "application/json"}
        answer = world.client.post("/register", content=text.encode(encoding), headers=headers)
        assert (plain.status_code, answer.json()["id"]) == (202, plain.json()["id"]), encoding
