"""POST /register: what becomes a job, and what was one already."""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from redis import Redis

from regnf_service.jobs.submit import job_id_of
from regnf_state.records import FieldRecord
from regnf_state.registration_request import RegistrationRequest
from tests.contract.world import BOX, World, assert_refused, field_bytes, make_world, sha256


def post(world: World, headers: dict[str, str] | None = None, **changes: Any) -> Any:
    return world.client.post("/register", json=world.valid_request() | changes, headers=headers)


def test_a_request_becomes_a_job_and_reaches_the_queue(world: World) -> None:
    answer = post(world, seed=7)
    assert answer.status_code == 202
    job = answer.json()
    assert answer.headers["location"] == f"/jobs/{job['id']}" == job["links"]["self"]
    assert answer.headers["retry-after"] == "1"
    assert (job["status"], job["queue_position"], job["attempts"]) == ("accepted", 1, 1)
    assert (job["inputs"]["seed"], job["inputs"]["scene"]) == (7, sha256(field_bytes("scene")))
    assert world.queue.registrations == [(job["id"], 1)]


def test_the_record_holds_the_canonical_request(world: World) -> None:
    job_id = post(world, options={"sampling": {"views": 9}}).json()["id"]
    record = world.records.get_job(job_id)
    assert record is not None
    detection = record.request["detection"]
    assert detection["rotation_quaternion_xyzw"] == [0.0, 0.0, 0.0, 1.0]
    assert [round(value, 9) for value in detection["center"] + detection["size"]] == [-0.15, -0.05, 0.2, 0.5, 0.5, 0.4]
    assert (detection["label"], detection["score"]) == (None, None)
    assert record.request["options"]["sampling"]["views"] == 9
    assert record.request["options"]["optimization"]["iterations"] == 200
    assert (record.request["seed"], record.request["ground_truth"]) == (0, None)
    assert set(record.request) == {
        "scene", "object", "candidates", "detection", "options", "seed", "initial_transform", "ground_truth", "version",
    }  # fmt: skip


def test_the_request_is_one_value_from_the_route_to_the_worker(world: World) -> None:
    request = world.valid_request() | {"detection": BOX | {"label": "chair"}, "seed": 3}
    told = world.client.post("/register", params={"dry_run": True}, json=request).json()
    record = world.records.get_job(post(world, **request).json()["id"])
    assert record is not None
    read = RegistrationRequest.from_record(record.request)
    assert read.to_record() == record.request
    assert read.values() == told["request"]
    assert job_id_of(read) == told["id"] == record.id
    assert (read.seed, read.detection.label, read.options.preset) == (3, "chair", "robust")


def test_a_request_without_pictures_is_another_job(world: World) -> None:
    usual, said, without = (post(world, **more).json() for more in ({}, {"pictures": True}, {"pictures": False}))
    assert usual["id"] == said["id"] != without["id"]
    assert (usual["inputs"]["pictures"], without["inputs"]["pictures"]) == (True, False)
    for id_, pictures in ((usual["id"], True), (without["id"], False)):
        record = world.records.get_job(id_)
        assert record is not None
        assert RegistrationRequest.from_record(record.request).pictures is pictures
    assert_refused(post(world, pictures="no"), 422, "INVALID_REQUEST")


def test_two_spellings_of_one_request_are_one_job(world: World) -> None:
    request = world.valid_request()
    box = {"center": [0, 0.25, 0.5], "size": [1, 1, 1]}
    turned = box | {"rotation_quaternion_xyzw": [0, 0, 0, -3]}
    spellings = [
        request | {"detection": box},
        request | {"detection": {"min": [-0.5, -0.25, 0.0], "max": [0.5, 0.75, 1.0]}, "seed": 0},
        request | {"scene": {"field": request["scene"]}, "detection": turned},
        request | {"detection": box | {"label": None}, "options": {"optimization": {"iterations": 200}}},
        request | {"detection": box, "options": {"optimization": {"iterations": 200.0}}, "seed": 0.0},
    ]
    assert len({world.client.post("/register", json=body).json()["id"] for body in spellings}) == 1
    assert len(world.queue.registrations) == 1


def test_a_label_and_a_score_make_no_other_job(world: World) -> None:
    box = {"center": [0, 0.25, 0.5], "size": [1, 1, 1]}
    first = post(world, detection=box | {"label": "chair", "score": 0.5}).json()
    second = post(world, detection=box | {"label": "armchair", "score": 0.75})
    assert second.json()["id"] == first["id"] == post(world, detection=box).json()["id"]
    assert world.queue.registrations == [(first["id"], 1)]
    record = world.records.get_job(first["id"])
    assert record is not None
    kept = record.request["detection"]
    assert (kept["label"], kept["score"]) == ("chair", 0.5)


def test_two_spellings_of_one_start_are_one_job(world: World) -> None:
    turned = [[0, -2, 0, 0.5], [2, 0, 0, 0], [0, 0, 2, -1], [0, 0, 0, 1]]
    half = 0.5**0.5
    spelled = {"matrix": turned, "scale": 2, "translation": [0.5, 0, -1]}
    spellings: list[Any] = [
        turned,
        {"matrix": [[float(value) or -0.0 for value in row] for row in turned]},
        spelled | {"rotation_quaternion_xyzw": [0, 0, half, half]},
        spelled | {"rotation_quaternion_xyzw": [0, 0, -3, -3]},
    ]
    jobs = [post(world, initial_transform=start).json() for start in spellings]
    assert len({job["id"] for job in jobs}) == 1
    assert jobs[0]["inputs"]["initial_transform"] == turned
    record = world.records.get_job(jobs[0]["id"])
    assert record is not None
    assert record.request["initial_transform"] == turned


def test_a_results_own_transform_is_a_start_and_a_truth(world: World) -> None:
    world.succeed(first := world.submit())
    found = world.client.get(f"/jobs/{first}/result").json()["T_object_scene"]
    answer = post(world, initial_transform=found, ground_truth={"T_object_scene": found})
    assert answer.status_code == 202, answer.text
    record = world.records.get_job(answer.json()["id"])
    assert record is not None
    assert record.request["initial_transform"] == found["matrix"] == record.request["ground_truth"]["T_object_scene"]


def test_no_start_is_the_same_as_none(world: World) -> None:
    assert post(world).json()["id"] == post(world, initial_transform=None).json()["id"]


def library(world: World, *names: str) -> dict[str, Any]:
    """A search among these objects, uploading them the first time."""
    request = world.valid_request()
    del request["object"]
    for name in names:
        if world.records.get_field(sha256(field_bytes(name))) is None:
            world.ready_field(name)
    return request | {"candidates": [sha256(field_bytes(name)) for name in names]}


def test_a_search_is_a_job_like_any_other(world: World) -> None:
    answer = world.client.post("/register", json=library(world, "chair", "table"))
    assert answer.status_code == 202, answer.text
    job = answer.json()
    assert (job["inputs"]["object"], job["inputs"]["candidates"]) == (None, 2)
    record = world.records.get_job(job["id"])
    assert record is not None
    assert record.request["object"] is None
    assert record.request["candidates"] == sorted(sha256(field_bytes(name)) for name in ("chair", "table"))


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


def test_the_order_of_candidates_and_their_spelling_say_nothing(world: World) -> None:
    request = library(world, "chair", "table", "can")
    spelled = [{"field": sha} for sha in reversed(request["candidates"])]
    ids = [
        world.client.post("/register", json=request | {"candidates": names}).json()["id"]
        for names in (request["candidates"], spelled)
    ]
    assert ids[0] == ids[1]
    fewer = request | {"candidates": request["candidates"][:2]}
    assert world.client.post("/register", json=fewer).json()["id"] != ids[0]


def test_a_search_among_one_is_not_its_registration(world: World) -> None:
    request = library(world, "chair")
    alone = {name: value for name, value in request.items() if name != "candidates"}
    alone["object"] = request["candidates"][0]
    ids = {world.client.post("/register", json=body).json()["id"] for body in (request, alone)}
    assert len(ids) == 2


def test_as_many_candidates_as_are_allowed(world: World) -> None:
    request, now = library(world), world.records.now()
    names = [f"{number:064x}" for number in range(512)]
    for sha in names:
        world.records.create_field(FieldRecord(sha, "validating", 600, now, now))
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
    truth = {"T_object_scene": [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]}
    changes: list[dict[str, Any]] = [
        {},
        {"seed": 1},
        {"options": {"sampling": {"views": 6}}},
        {"detection": BOX | {"max": [0.1, 0.3, 0.4]}},
        {"ground_truth": truth},
        {"initial_transform": truth["T_object_scene"]},
        {"scene": world.valid_request()["object"]},
    ]
    assert len({post(world, **change).json()["id"] for change in changes}) == len(changes)


def test_an_identical_finished_job_answers_200(world: World) -> None:
    world.succeed(world.submit())
    answer = post(world)
    assert (answer.status_code, answer.json()["status"]) == (200, "successful")
    assert "result" in answer.json()["links"]


def test_a_failed_job_is_started_anew(world: World) -> None:
    job_id = world.submit()
    world.fail(job_id, reason="NO_INITIAL_TRANSFORM")
    answer = post(world)
    assert (answer.status_code, answer.json()["attempts"], answer.json()["error"]) == (202, 2, None)
    assert world.queue.registrations[-1] == (job_id, 2)


def test_a_job_that_was_never_queued_is_queued_by_the_next_call(world: World) -> None:
    job_id = world.submit()
    world.queue.lose()
    assert post(world).status_code == 202
    assert world.queue.registrations == [(job_id, 1)]


def test_fields_that_are_still_validating_are_accepted(world: World) -> None:
    request = world.valid_request()
    data = field_bytes("late")
    world.client.put(f"/fields/{sha256(data)}", content=data)
    assert world.client.post("/register", json=request | {"object": sha256(data)}).status_code == 202


def test_prefer_wait_answers_once_the_job_has_finished(world: World) -> None:
    def finish() -> None:
        deadline = time.monotonic() + 10
        while not world.queue.registrations and time.monotonic() < deadline:
            time.sleep(0.01)
        world.succeed(world.queue.registrations[0][0])

    world.valid_request()
    worker = threading.Thread(target=finish)
    worker.start()
    answer = post(world, headers={"Prefer": "respond-async, wait=20"})
    worker.join()
    assert (answer.status_code, answer.json()["status"]) == (200, "successful")
    assert answer.headers["preference-applied"] == "wait=20"


def test_prefer_wait_gives_up_in_time(world: World) -> None:
    answer = post(world, headers={"Prefer": "wait=1"})
    assert (answer.status_code, answer.json()["status"]) == (202, "accepted")


def test_a_dry_run_starts_nothing(world: World) -> None:
    answer = world.client.post("/register?dry_run=true", json=world.valid_request())
    assert answer.status_code == 200
    assert answer.json()["valid"] is True
    assert world.records.list_jobs(None, 10, None).records == []
    assert answer.json()["id"] == post(world).json()["id"]


def test_an_idempotency_key_returns_the_first_answer_even_of_a_failed_job(world: World) -> None:
    key = {"Idempotency-Key": "run-1"}
    job_id = post(world, headers=key).json()["id"]
    world.fail(job_id, reason="NO_INITIAL_TRANSFORM")
    again = post(world, headers=key)
    assert (again.status_code, again.json()["status"], again.json()["attempts"]) == (200, "failed", 1)
    assert post(world, headers={"Idempotency-Key": "run-2"}).json()["attempts"] == 2


def test_an_idempotency_key_belongs_to_one_request(world: World) -> None:
    key = {"Idempotency-Key": "run-1"}
    assert post(world, headers=key).status_code == 202
    assert_refused(post(world, headers=key, seed=1), 422, "IDEMPOTENCY_KEY_REUSED")


def test_a_full_queue_says_when_to_come_back(tmp_path: Path, any_redis: Redis) -> None:
    world = make_world(tmp_path, any_redis, max_queued_jobs=1)
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


def test_one_shot_keeps_nothing_of_a_request_that_is_refused(world: World) -> None:
    question = {"detection": BOX, "options": {"unknown": 1}}
    answer = world.client.post("/register", files=one_shot(field_bytes("one"), field_bytes("two"), question))
    assert_refused(answer, 422, "INVALID_OPTIONS")
    missing: dict[str, Any] = {
        "scene": ("scene", field_bytes("one")),
        "request": (None, json.dumps({"detection": BOX})),
    }
    assert_refused(world.client.post("/register", files=missing), 400, "MALFORMED_MULTIPART")
    assert world.blobs.blobs == {}
    assert world.records.list_fields(None, 10, None).records == []


def test_a_one_shot_dry_run_keeps_nothing(world: World) -> None:
    files = one_shot(field_bytes("one"), field_bytes("two"), {"detection": BOX})
    assert world.client.post("/register?dry_run=true", files=files).json()["valid"] is True
    assert world.blobs.blobs == {}


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


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-be", "utf-32", "cp1252"])
def test_a_request_as_another_editor_saves_it(world: World, encoding: str) -> None:
    request = world.valid_request()
    plain = world.client.post("/register", json=request)
    text = json.dumps(request, indent=1).replace("\n", "\r\n")
    answer = world.client.post("/register", content=text.encode(encoding), headers={"Content-Type": "application/json"})
    assert (plain.status_code, answer.json()["id"]) == (202, plain.json()["id"])
