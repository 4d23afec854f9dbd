"""POST /render as a job like any other: one request is one job, and edits name finished registrations."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from regnf_service.http.schemas.scenes import MOST_CAMERAS
from regnf_state.registration_request import RenderingRequest, request_of
from tests.contract.test_openapi import validator
from tests.contract.world import ALICE, BOB, BOX, RESULT, TOKENS, World, assert_refused, field_bytes, sha256, transform
from tests.stores import expire

MATRIX = transform(2.0)["matrix"]
STATION = {"position": [0.9, 0.0, 0.5], "target": [0.0, 0.0, 0.0]}


def registered(world: World, **changes: Any) -> str:
    """A finished registration; its job's id."""
    job_id = world.submit(**changes)
    world.succeed(job_id)
    return job_id


def rendering(world: World, **changes: Any) -> dict[str, Any]:
    """A request whose object and transform are given."""
    known = world.valid_request()
    edit = {"kind": "substitution", "object": known["object"], "T_object_scene": MATRIX}
    return {"scene": known["scene"], "edits": [edit], "size": [64, 48], "orbit": {"frames": 4}} | changes


def asked_of(world: World, job_id: str) -> RenderingRequest:
    record = world.records.get_job(job_id)
    assert record is not None
    found = request_of(record)
    assert isinstance(found, RenderingRequest)
    return found


def test_a_rendering_is_a_job(world: World) -> None:
    answer = world.client.post("/render", json=rendering(world))
    assert answer.status_code == 202, answer.text
    job = answer.json()
    validator("JobDocument").validate(job)
    assert (job["kind"], job["status"], answer.headers["location"]) == ("render", "accepted", f"/jobs/{job['id']}")
    assert job["inputs"]["edits"] == ["substitution"]
    assert (job["inputs"]["frames"], job["inputs"]["size"]) == (4, [64, 48])
    assert world.queue.registrations[-1][:2] == (job["id"], 1)
    assert world.client.get("/jobs").json()["jobs"][0]["id"] == job["id"]
    assert world.client.post(f"/jobs/{job['id']}/cancel").json()["status"] == "dismissed"


def test_the_same_request_is_the_same_job(world: World) -> None:
    def id_of(**changes: Any) -> str:
        return str(world.client.post("/render", json=rendering(world, **changes)).json()["id"])

    first = id_of()
    labeled = {"kind": "removal", "detection": BOX | {"label": "chair", "score": 0.5}}
    assert id_of(seed=0, before=True, options={"mode": "surface"}) == first, "defaults may be spelled out"
    assert id_of(outputs=["color", "depth", "normal", "strip", "strip"]) == first
    assert id_of(edits=[labeled]) == id_of(edits=[{"kind": "removal", "detection": BOX}])
    others = [{"seed": 1}, {"size": [64, 49]}, {"before": False}, {"edits": []}, {"options": {"mode": "volume"}}]
    ids = [first, *(id_of(**change) for change in others)]
    assert len(set(ids)) == len(ids)


def test_a_dry_run_and_a_key(world: World) -> None:
    asked = rendering(world)
    dry = world.client.post("/render?dry_run=true", json=asked).json()
    assert world.records.list_jobs(None, 10, None).records == []
    key = {"Idempotency-Key": "once"}
    made = world.client.post("/render", json=asked, headers=key).json()
    assert made["id"] == dry["id"]
    assert dry["request"]["edits"][0]["T_object_scene"] == MATRIX
    assert_refused(world.client.post("/render", json=asked | {"seed": 5}, headers=key), 422, "IDEMPOTENCY_KEY_REUSED")


@pytest.mark.parametrize("kind", ["substitution", "replacement", "removal"])
def test_an_edit_may_name_a_registration(world: World, kind: str) -> None:
    job = registered(world)
    known = world.valid_request()
    edit = {"kind": kind, "job": job} | ({"replacement": known["object"]} if kind == "replacement" else {})
    answer = world.client.post("/render", json=rendering(world, edits=[edit]))
    assert answer.status_code == 202, answer.text
    asked = asked_of(world, answer.json()["id"])
    (found,) = asked.rendering.edits
    assert (found.kind, found.object, found.T_object_scene) == (kind, known["object"], MATRIX)
    assert asked.objects == (known["object"],)
    world.client.delete(f"/jobs/{job}")
    again = asked_of(world, answer.json()["id"])
    assert again == asked, "what it needs is its own"


def test_the_residual_of_a_result_is_used_in_object_units(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(RESULT, "metrics", {"residual_rms": 0.002, "object_diameter": 3.0})
    job = registered(world)
    posted = [
        world.client.post("/render", json=rendering(world, edits=[{"kind": "substitution", "job": job} | more]))
        for more in ({}, {"residual": 0.5})
    ]
    found = [asked_of(world, one.json()["id"]).rendering.edits[0] for one in posted]
    assert [getattr(one, "residual", None) for one in found] == [0.006, 0.5]


def test_edits_of_jobs_that_are_of_no_use(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    waiting, failed = world.submit(seed=1), world.submit(seed=2)
    world.fail(failed, reason="NO_SURFACE_IN_OBJECT", detail="nothing there")
    dismissed = world.submit(seed=3)
    world.client.post(f"/jobs/{dismissed}/cancel")
    monkeypatch.setitem(RESULT, "verdict", "rejected")
    rejected = registered(world, seed=4)
    monkeypatch.setitem(RESULT, "verdict", "registered")
    elsewhere = registered(world, seed=5, scene=world.ready_field("another scene"))
    picture = world.client.post("/render", json=rendering(world)).json()["id"]
    jobs = {
        "0" * 32: (404, "JOB_NOT_FOUND"),
        waiting: (409, "JOB_NOT_READY"),
        failed: (409, "JOB_FAILED"),
        dismissed: (409, "JOB_DISMISSED"),
        rejected: (422, "EDIT_INVALID"),
        elsewhere: (422, "EDIT_INVALID"),
        picture: (422, "EDIT_INVALID"),
    }
    before = len(world.queue.registrations)
    for job, refusal in jobs.items():
        good = {"kind": "removal", "detection": BOX}
        answer = world.client.post("/render", json=rendering(world, edits=[good, {"kind": "substitution", "job": job}]))
        problem = assert_refused(answer, *refusal)
        assert problem["errors"][0]["pointer"] == "/edits/1/job"
    assert len(world.queue.registrations) == before
    known = world.valid_request()
    insisted = {"kind": "substitution", "object": known["object"], "T_object_scene": RESULT["T_object_scene"]}
    assert world.client.post("/render", json=rendering(world, edits=[insisted])).status_code in (200, 202)


def test_a_job_that_has_expired_is_told_apart(world: World) -> None:
    job = registered(world)
    expire(world.redis, job)
    edit = {"kind": "substitution", "job": job}
    assert_refused(world.client.post("/render", json=rendering(world, edits=[edit])), 410, "JOB_EXPIRED")


def test_cameras_of_a_file(world: World) -> None:
    turned = [[0.0, 0.0, 1.0, 2.0], [1.0, 0.0, 0.0, 0.5], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    frames = [{"file_path": f"{n}.png", "transform_matrix": turned} for n in range(8)]
    document = {"fl_x": 100.0, "fl_y": 100.0, "cx": 50.0, "cy": 40.0, "w": 100, "h": 80, "frames": frames}
    file: dict[str, Any] = {"document": document, "every": 3, "T_scene_file": MATRIX}
    asked = rendering(world, orbit=None, transforms=file, size=[50, 40])
    asked.pop("orbit")
    job = world.client.post("/render", json=asked)
    assert job.status_code == 202, job.text
    poses = asked_of(world, job.json()["id"]).rendering.poses
    assert poses is not None
    assert len(poses) == 3
    assert poses[0].intrinsics == [50.0, 50.0, 25.0, 20.0]
    expected = np.array(turned) @ np.diag([1.0, -1.0, -1.0, 1.0])
    expected[:3, 3] *= 2.0  # the scene's unit is half of the file's, its axes are the same
    assert np.allclose(poses[0].T_scene_camera, expected)
    many = document | {"frames": frames * 40}
    refused = world.client.post("/render", json=asked | {"transforms": {"document": many}})
    problem = assert_refused(refused, 422, "RENDER_TOO_LARGE")
    assert str(MOST_CAMERAS) in problem["detail"]
    assert world.client.post("/render", json=asked | {"transforms": {"document": many, "every": 2}}).status_code == 202


def test_the_result_says_what_each_file_shows(world: World) -> None:
    job = world.client.post("/render", json=rendering(world)).json()["id"]
    shown = {"name": "frame-0000.png", "kind": "color", "media_type": "image/png", "frame": 0, "before": False}
    result = {"frames": 4, "size": [64, 48], "depth_unit": 0.001, "field": None, "artifacts": [shown]}
    files = {"result.json": json.dumps(result).encode(), "frame-0000.png": b"png", "odd-name.png": b"x"}
    world.succeed(job, files)
    document = world.client.get(f"/jobs/{job}").json()
    assert (document["status"], document["verdict"]) == ("successful", None)
    told = world.client.get(f"/jobs/{job}/result").json()
    validator("RenderResultDocument").validate(told)
    listed = {one["name"]: one for one in told["artifacts"]}
    assert listed.keys() == {"result.json", "frame-0000.png"}
    assert listed["frame-0000.png"]["frame"] == 0
    answer = world.client.get(listed["frame-0000.png"]["url"])
    assert (answer.content, answer.headers["content-type"]) == (b"png", "image/png")
    assert_refused(world.client.get(f"/jobs/{job}/artifacts/odd-name.png"), 404, "ARTIFACT_NOT_FOUND")


def test_a_field_that_edits_need_is_in_use(world: World) -> None:
    world.client.post("/render", json=rendering(world))
    object_ = sha256(field_bytes("object"))
    assert_refused(world.client.delete(f"/fields/{object_}"), 409, "FIELD_IN_USE")


def test_jobs_of_others_cannot_be_named(worlds: Any) -> None:
    world: World = worlds(api_tokens=TOKENS)
    with world.client:
        data = {name: field_bytes(name) for name in ("scene", "object")}
        for who in (ALICE, BOB):
            for one in data.values():
                assert world.client.put(f"/fields/{sha256(one)}", content=one, headers=who).status_code == 201
        request = {name: sha256(one) for name, one in data.items()} | {"detection": BOX}
        job = world.client.post("/register", json=request, headers=ALICE).json()["id"]
        world.succeed(job)
        asked = {"scene": request["scene"], "edits": [{"kind": "substitution", "job": job}]}
        assert_refused(world.client.post("/render", json=asked, headers=BOB), 404, "JOB_NOT_FOUND")
        mine = world.client.post("/render", json=asked, headers=ALICE)
        assert mine.status_code == 202, mine.text
        assert asked_of(world, mine.json()["id"]).objects == (f"{request['object']}_alice",)
        assert_refused(world.client.get(f"/jobs/{mine.json()['id']}", headers=BOB), 404, "JOB_NOT_FOUND")
