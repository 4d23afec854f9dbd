"""Renderings that cannot be made are refused before a job exists, with a reason and a place, and leave nothing."""

from __future__ import annotations

from typing import Any

import pytest

from regnf_state.reasons import REASONS
from tests.contract.bad_input import post
from tests.contract.world import BOX, World, assert_refused, field_bytes, pointers, sha256, transform

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
