"""POST /render as a job like any other: one request is one job, and edits name finished registrations."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest

from regnf_service.http.schemas.scenes import MOST_CAMERAS
from regnf_state.reasons import REASONS
from regnf_state.registration_request import RenderingRequest, request_of
from tests.contract.conftest import post
from tests.contract.test_openapi import validator
from tests.contract.world import (
    ALICE,
    BOB,
    BOX,
    RESULT,
    TOKENS,
    World,
    assert_refused,
    field_bytes,
    pointers,
    put,
    sha256,
    transform,
)
from tests.stores import expire

MATRIX = transform(2.0)["matrix"]
STATION = {"position": [0.9, 0.0, 0.5], "target": [0.0, 0.0, 0.0]}


def registered(world: World, **changes: Any) -> str:
    job_id = world.submit(**changes)
    world.succeed(job_id)
    return job_id


def rendering(world: World, **changes: Any) -> dict[str, Any]:
    known = world.valid_request()
    edit = {"kind": "substitution", "object": known["object"], "T_object_scene": MATRIX}
    return {"scene": known["scene"], "edits": [edit], "size": [64, 48], "orbit": {"frames": 4}} | changes


def render(world: World, headers: dict[str, str] | None = None, **changes: Any) -> httpx.Response:
    return world.client.post("/render", json=rendering(world, **changes), headers=headers)


def asked_of(world: World, answer: httpx.Response) -> RenderingRequest:
    """What the record of a rendering's job holds of its request."""
    assert answer.status_code == 202, answer.text
    found = request_of(world.job(answer.json()["id"]))
    assert isinstance(found, RenderingRequest)
    return found


def test_a_rendering_is_a_job(world: World) -> None:
    answer = render(world)
    assert answer.status_code == 202, answer.text
    job = answer.json()
    validator("JobDocument").validate(job)
    assert (job["kind"], job["status"], answer.headers["location"]) == ("render", "accepted", f"/jobs/{job['id']}")
    expected = {"edits": ["substitution"], "frames": 4, "size": [64, 48]}
    assert {name: job["inputs"][name] for name in expected} == expected
    assert world.queue.registrations[-1][:2] == (job["id"], 1)
    assert world.client.get("/jobs").json()["jobs"][0]["id"] == job["id"]
    object_ = sha256(field_bytes("object"))
    assert_refused(world.client.delete(f"/fields/{object_}"), 409, "FIELD_IN_USE")
    assert world.client.post(f"/jobs/{job['id']}/cancel").json()["status"] == "dismissed"


def test_the_same_request_is_the_same_job(world: World) -> None:
    def id_of(**changes: Any) -> str:
        return str(render(world, **changes).json()["id"])

    first = id_of()
    labeled = {"kind": "removal", "detection": BOX | {"label": "chair", "score": 0.5}}
    assert id_of(seed=0, before=True, options={"mode": "surface"}) == first, "defaults may be spelled out"
    assert id_of(outputs=["color", "depth", "normal", "strip", "strip"]) == first
    assert id_of(edits=[labeled]) == id_of(edits=[{"kind": "removal", "detection": BOX}])
    others = [{"seed": 1}, {"size": [64, 49]}, {"before": False}, {"edits": []}, {"options": {"mode": "volume"}}]
    ids = [first, *(id_of(**change) for change in others)]
    assert len(set(ids)) == len(ids)


def test_a_dry_run_and_a_key(world: World) -> None:
    dry = world.client.post("/render?dry_run=true", json=rendering(world)).json()
    assert world.records.list_jobs(None, 10, None).records == []
    key = {"Idempotency-Key": "once"}
    assert render(world, key).json()["id"] == dry["id"]
    assert dry["request"]["edits"][0]["T_object_scene"] == MATRIX
    assert_refused(render(world, key, seed=5), 422, "IDEMPOTENCY_KEY_REUSED")


def test_an_edit_may_name_a_registration(world: World) -> None:
    job, known = registered(world), world.valid_request()["object"]
    asked = {}
    for kind in ("substitution", "replacement", "removal"):
        edit = {"kind": kind, "job": job} | ({"replacement": known} if kind == "replacement" else {})
        answer = render(world, edits=[edit])
        request = asked_of(world, answer)
        (found,) = request.rendering.edits
        assert (found.kind, found.object, found.T_object_scene) == (kind, known, MATRIX)
        assert request.objects == (known,)
        asked[kind] = answer, request
    world.client.delete(f"/jobs/{job}")
    for answer, request in asked.values():
        assert asked_of(world, answer) == request, "what it needs is its own"


def test_the_residual_of_a_result_is_used_in_object_units(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(RESULT, "metrics", {"residual_rms": 0.002, "object_diameter": 3.0})
    job = registered(world)
    posted = [render(world, edits=[{"kind": "substitution", "job": job} | more]) for more in ({}, {"residual": 0.5})]
    found = [asked_of(world, one).rendering.edits[0] for one in posted]
    assert [getattr(one, "residual", None) for one in found] == [0.006, 0.5]


def test_edits_of_jobs_that_are_of_no_use(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    waiting, failed, dismissed = (world.submit(seed=seed) for seed in (1, 2, 3))
    world.fail(failed, reason="NO_SURFACE_IN_OBJECT", detail="nothing there")
    world.client.post(f"/jobs/{dismissed}/cancel")
    expired = registered(world, seed=6)
    expire(world.redis, expired)
    with monkeypatch.context() as patch:
        patch.setitem(RESULT, "verdict", "rejected")
        rejected = registered(world, seed=4)
    elsewhere = registered(world, seed=5, scene=world.ready_field("another scene"))
    jobs = {
        "0" * 32: (404, "JOB_NOT_FOUND"), waiting: (409, "JOB_NOT_READY"), failed: (409, "JOB_FAILED"),
        dismissed: (409, "JOB_DISMISSED"), expired: (410, "JOB_EXPIRED"), rejected: (422, "EDIT_INVALID"),
        elsewhere: (422, "EDIT_INVALID"), render(world).json()["id"]: (422, "EDIT_INVALID"),
    }  # fmt: skip
    before = len(world.queue.registrations)
    for job, refusal in jobs.items():
        edits = [{"kind": "removal", "detection": BOX}, {"kind": "substitution", "job": job}]
        problem = assert_refused(render(world, edits=edits), *refusal)
        assert refusal[0] == 410 or pointers(problem) == ["/edits/1/job"]
    assert len(world.queue.registrations) == before
    known = world.valid_request()["object"]
    insisted = {"kind": "substitution", "object": known, "T_object_scene": RESULT["T_object_scene"]}
    assert render(world, edits=[insisted]).status_code in (200, 202)


def test_cameras_of_a_file(world: World) -> None:
    turned = [[0.0, 0.0, 1.0, 2.0], [1.0, 0.0, 0.0, 0.5], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    frames = [{"file_path": f"{n}.png", "transform_matrix": turned} for n in range(8)]
    document = {"fl_x": 100.0, "fl_y": 100.0, "cx": 50.0, "cy": 40.0, "w": 100, "h": 80, "frames": frames}
    asked = rendering(world, size=[50, 40])
    del asked["orbit"]

    def posted(frames: list[Any], **more: Any) -> httpx.Response:
        file = {"document": document | {"frames": frames}, **more}
        return world.client.post("/render", json=asked | {"transforms": file})

    poses = asked_of(world, posted(frames, every=3, T_scene_file=MATRIX)).rendering.poses or []
    assert len(poses) == 3
    assert poses[0].intrinsics == [50.0, 50.0, 25.0, 20.0]
    expected = np.array(turned) @ np.diag([1.0, -1.0, -1.0, 1.0])
    expected[:3, 3] *= 2.0  # the scene's unit is half of the file's, its axes are the same
    assert np.allclose(poses[0].T_scene_camera, expected)
    assert str(MOST_CAMERAS) in assert_refused(posted(frames * 40), 422, "RENDER_TOO_LARGE")["detail"]
    assert posted(frames * 40, every=2).status_code == 202


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


def test_jobs_of_others_cannot_be_named(worlds: Callable[..., World]) -> None:
    client = (world := worlds(api_tokens=TOKENS)).client
    for who in (ALICE, BOB):
        known = {name: put(client, field_bytes(name), **who).json()["sha256"] for name in ("scene", "object")}
    job = client.post("/register", json=known | {"detection": BOX}, headers=ALICE).json()["id"]
    world.succeed(job)
    asked = {"scene": known["scene"], "edits": [{"kind": "substitution", "job": job}]}
    assert_refused(client.post("/render", json=asked, headers=BOB), 404, "JOB_NOT_FOUND")
    mine = client.post("/render", json=asked, headers=ALICE)
    assert asked_of(world, mine).objects == (f"{known['object']}_alice",)
    assert_refused(client.get(f"/jobs/{mine.json()['id']}", headers=BOB), 404, "JOB_NOT_FOUND")


# renderings that cannot be made are refused before a job exists, with a reason and a place, and leave nothing


stays = pytest.mark.usefixtures("nothing_of_a_request_stays")
OBJECT = sha256(field_bytes("object"))
MATRIX = transform(2.0)["matrix"]
EDIT: dict[str, Any] = {"kind": "substitution", "object": OBJECT, "T_object_scene": MATRIX}
STATION: dict[str, Any] = {"position": [0.9, 0.0, 0.5], "target": [0.0, 0.0, 0.0]}
POSE: dict[str, Any] = {"T_scene_camera": transform()["matrix"], "intrinsics": [50, 50, 32, 24], "size": [64, 48]}
SHEARED = [[1, 0.5, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
MIRROR = [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
FAR = {"min": [50, 50, 50], "max": [51, 51, 51]}


def edit(**changes: Any) -> dict[str, Any]:
    return {"edits": [EDIT | changes]}


def removal(box: Any) -> dict[str, Any]:
    return {"edits": [{"kind": "removal", "detection": box}]}


def pose(**changes: Any) -> dict[str, Any]:
    return {"poses": [POSE | changes]}


BAD: dict[str, list[tuple[dict[str, Any], str]]] = {
    "INVALID_TRANSFORM": [
        (edit(T_object_scene=SHEARED), "/edits/0/T_object_scene"),
        (edit(T_object_scene=MIRROR), "/edits/0/T_object_scene"),
        (edit(T_object_scene=[[float("nan"), 0, 0, 0], *MATRIX[1:]]), "/edits/0/T_object_scene/0/0"),
        (edit(T_object_scene=[[2, 0, 0, 1e300], *MATRIX[1:]]), "/edits/0/T_object_scene/0/3"),
    ],
    "EDIT_INVALID": [
        ({"edits": [{"kind": "removal", "T_object_scene": MATRIX}]}, "/edits/0"),
        ({"edits": [{"kind": "substitution"}]}, "/edits/0"), ({"edits": [{"kind": "explosion"}]}, "/edits/0"),
        (edit(job="0" * 32), "/edits/0"),
        ({"edits": EDIT}, "/edits"), ({"edits": [EDIT] * 65}, "/edits"), (edit(colour=1), "/edits/0/colour"),
        (edit(tint=[2, 0, 0]), "/edits/0/tint/0"), (edit(object="abc"), "/edits/0/object"),
        ({"edits": [{"kind": "substitution", "job": "../x"}]}, "/edits/0/job"),
    ],
    "INVALID_DETECTION": [(removal({"min": [0, 0, 0], "max": [0, 1, 1]}), "/edits/0/detection/max/0")],
    "DETECTION_OUTSIDE_SCENE": [(removal(FAR), "/edits/0/detection"),
    ({"orbit": {"detection": FAR}}, "/orbit/detection")],
    "FIELD_NOT_FOUND": [(edit(object="0" * 64), "/edits/0/object"), ({"scene": "0" * 64}, "/scene")],
    "RENDER_TOO_LARGE": [
        ({"size": [40_000, 25_000]}, ""), ({"orbit": {"frames": 1_000_000}}, ""),
        ({"size": [4000, 4000], "orbit": {"frames": 2000}}, ""),
        ({"size": [1920, 1080], "orbit": {"frames": 360}, "options": {"mode": "volume"}, "outputs": ["animation"],
          "before": False}, "/size"),  # more work than a job may be
        ({"size": [640, 480], "orbit": {"frames": 1000}, "edits": [EDIT]}, "/outputs"),  # more files
        ({"options": {"memory_mb": 65536}, "size": [4000, 4000], "orbit": {"frames": 1}}, "/size"),
        ({"outputs": ["field"], "field_resolution": 900}, "/field_resolution"),
    ],
    "CAMERA_INVALID": [
        ({"size": [0, 48]}, "/size/0"), ({"look_at": []}, "/look_at"), ({"orbit": {"edit": 3}}, ""),
        ({"look_at": [STATION | {"target": STATION["position"]}]}, "/look_at/0"),
        (pose(T_scene_camera=SHEARED), "/poses/0/T_scene_camera"), (pose(T_scene_camera=MATRIX), "/poses/0"),
        (pose(intrinsics=[0, 50, 32, 24]), "/poses/0"),
        ({"transforms": {"document": {"frames": "no"}}}, ""), ({"transforms": {"document": {}}}, ""),
    ],
    "INVALID_REQUEST": [
        ({"orbit": {}, "look_at": [STATION]}, ""), ({"outputs": ["hologram"]}, "/outputs/0"),
        ({"outputs": []}, "/outputs"),
        ({"camera": 1}, "/camera"), ({"seed": "1"}, "/seed"),
    ],
    "INVALID_OPTIONS": [({"options": {"fog": 1}}, "/options/fog"),
    ({"options": {"antialias": 9}}, "/options/antialias")],
    "WEBHOOK_NOT_ALLOWED": [({"webhook": {"url": "https://elsewhere.example/"}}, "/webhook/url")],
}  # fmt: skip


@stays
@pytest.mark.parametrize("reason", BAD)
def test_refused(world: World, reason: str) -> None:
    scene = world.valid_request()["scene"]
    for change, pointer in BAD[reason]:
        answer = post(world, {"scene": scene, "size": [64, 48]} | change, "/render")
        problem = assert_refused(answer, REASONS[reason].status, reason)
        found = pointers(problem) if "errors" in problem else []
        assert pointer in found or (pointer == "" and not any(found)), (change, problem)


@stays
def test_bodies_that_are_no_request(world: World) -> None:
    for body in (b"", b"[]", b"null", b"{", b'{"scene": 1}', b"\xff"):
        answer = post(world, body, "/render")
        assert answer.status_code in (400, 422), answer.text
        assert_refused(answer, answer.status_code, answer.json()["reason"])
    assert_refused(world.client.post("/render", files={"scene": b"x"}), 415, "UNSUPPORTED_MEDIA_TYPE")


def test_a_rejected_object_is_refused(world: World) -> None:
    scene, object_ = world.valid_request()["scene"], world.rejected_field("a broken chair")
    edits = [EDIT | {"object": object_}, {"kind": "removal", "detection": BOX}]
    problem = assert_refused(post(world, {"scene": scene, "edits": edits}, "/render"), 422, "FIELD_REJECTED")
    assert pointers(problem) == ["/edits/0/object"]
