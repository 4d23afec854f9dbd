"""Renderings that cannot be made are refused before a job exists, with a reason and a place, and leave nothing."""

from __future__ import annotations

from typing import Any

import pytest

from regnf_state.reasons import REASONS
from tests.contract import bad_input
from tests.contract.world import BOX, World, assert_refused, field_bytes, sha256, transform

OBJECT = sha256(field_bytes("object"))
MATRIX = transform(2.0)["matrix"]
EDIT = {"kind": "substitution", "object": OBJECT, "T_object_scene": MATRIX}
STATION = {"position": [0.9, 0.0, 0.5], "target": [0.0, 0.0, 0.0]}
POSE = {"T_scene_camera": transform()["matrix"], "intrinsics": [50, 50, 32, 24], "size": [64, 48]}
SHEARED = [[1, 0.5, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
MIRROR = [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
FAR = {"min": [50, 50, 50], "max": [51, 51, 51]}

BAD: dict[str, tuple[dict[str, Any], str, str]] = {
    "a transform that is no Sim(3)": (
        {"edits": [EDIT | {"T_object_scene": SHEARED}]},
        "INVALID_TRANSFORM",
        "/edits/0/T_object_scene",
    ),
    "a mirror": ({"edits": [EDIT | {"T_object_scene": MIRROR}]}, "INVALID_TRANSFORM", "/edits/0/T_object_scene"),
    "a transform without its object": (
        {"edits": [{"kind": "removal", "T_object_scene": MATRIX}]},
        "EDIT_INVALID",
        "/edits/0",
    ),
    "a substitution of nothing": ({"edits": [{"kind": "substitution"}]}, "EDIT_INVALID", "/edits/0"),
    "both a job and an object": ({"edits": [EDIT | {"job": "0" * 32}]}, "EDIT_INVALID", "/edits/0"),
    "an edit of another kind": ({"edits": [{"kind": "explosion"}]}, "EDIT_INVALID", "/edits/0"),
    "edits that are no list": ({"edits": EDIT}, "EDIT_INVALID", "/edits"),
    "too many edits": ({"edits": [EDIT] * 65}, "EDIT_INVALID", "/edits"),
    "an unknown member of an edit": ({"edits": [EDIT | {"colour": 1}]}, "EDIT_INVALID", "/edits/0/colour"),
    "a tint beyond 1": ({"edits": [EDIT | {"tint": [2, 0, 0]}]}, "EDIT_INVALID", "/edits/0/tint/0"),
    "a box to remove that is none": (
        {"edits": [{"kind": "removal", "detection": {"min": [0, 0, 0], "max": [0, 1, 1]}}]},
        "INVALID_DETECTION",
        "/edits/0/detection/max/0",
    ),
    "a box outside of the scene": (
        {"edits": [{"kind": "removal", "detection": FAR}]},
        "DETECTION_OUTSIDE_SCENE",
        "/edits/0/detection",
    ),
    "an orbit round a box outside": ({"orbit": {"detection": FAR}}, "DETECTION_OUTSIDE_SCENE", "/orbit/detection"),
    "an object that is not there": ({"edits": [EDIT | {"object": "0" * 64}]}, "FIELD_NOT_FOUND", "/edits/0/object"),
    "a scene that is not there": ({"scene": "0" * 64}, "FIELD_NOT_FOUND", "/scene"),
    "a hash of another length": ({"edits": [EDIT | {"object": "abc"}]}, "EDIT_INVALID", "/edits/0/object"),
    "a job's id that is none": ({"edits": [{"kind": "substitution", "job": "../x"}]}, "EDIT_INVALID", "/edits/0/job"),
    "a billion pixels": ({"size": [40_000, 25_000]}, "RENDER_TOO_LARGE", ""),
    "a million frames": ({"orbit": {"frames": 1_000_000}}, "RENDER_TOO_LARGE", ""),
    "pixels times frames": ({"size": [4000, 4000], "orbit": {"frames": 2000}}, "RENDER_TOO_LARGE", ""),
    "more work than a job may be": (
        {
            "size": [1920, 1080],
            "orbit": {"frames": 360},
            "options": {"mode": "volume"},
            "outputs": ["animation"],
            "before": False,
        },
        "RENDER_TOO_LARGE",
        "/size",
    ),
    "more files than a job may write": (
        {"size": [640, 480], "orbit": {"frames": 1000}, "edits": [EDIT]},
        "RENDER_TOO_LARGE",
        "/outputs",
    ),
    "more memory than a job may have": (
        {"options": {"memory_mb": 65536}, "size": [4000, 4000], "orbit": {"frames": 1}},
        "RENDER_TOO_LARGE",
        "/size",
    ),
    "a field too fine": ({"outputs": ["field"], "field_resolution": 900}, "RENDER_TOO_LARGE", "/field_resolution"),
    "no pixels": ({"size": [0, 48]}, "CAMERA_INVALID", "/size/0"),
    "two kinds of cameras": ({"orbit": {}, "look_at": [STATION]}, "INVALID_REQUEST", ""),
    "no station": ({"look_at": []}, "CAMERA_INVALID", "/look_at"),
    "a station that looks at itself": (
        {"look_at": [STATION | {"target": STATION["position"]}]},
        "CAMERA_INVALID",
        "/look_at/0",
    ),
    "an orbit round an edit that is not there": ({"orbit": {"edit": 3}}, "CAMERA_INVALID", ""),
    "a pose that is no rotation": (
        {"poses": [POSE | {"T_scene_camera": SHEARED}]},
        "CAMERA_INVALID",
        "/poses/0/T_scene_camera",
    ),
    "a pose with a scale": ({"poses": [POSE | {"T_scene_camera": MATRIX}]}, "CAMERA_INVALID", "/poses/0"),
    "a lens of no length": ({"poses": [POSE | {"intrinsics": [0, 50, 32, 24]}]}, "CAMERA_INVALID", "/poses/0"),
    "a file of cameras that is none": ({"transforms": {"document": {"frames": "no"}}}, "CAMERA_INVALID", ""),
    "an empty file of cameras": ({"transforms": {"document": {}}}, "CAMERA_INVALID", ""),
    "an output of another kind": ({"outputs": ["hologram"]}, "INVALID_REQUEST", "/outputs/0"),
    "no output": ({"outputs": []}, "INVALID_REQUEST", "/outputs"),
    "an unknown option": ({"options": {"fog": 1}}, "INVALID_OPTIONS", "/options/fog"),
    "an option out of its range": ({"options": {"antialias": 9}}, "INVALID_OPTIONS", "/options/antialias"),
    "an unknown member": ({"camera": 1}, "INVALID_REQUEST", "/camera"),
    "a number that is a text": ({"seed": "1"}, "INVALID_REQUEST", "/seed"),
    "NaN in a transform": (
        {"edits": [EDIT | {"T_object_scene": [[float("nan"), 0, 0, 0], *MATRIX[1:]]}]},
        "INVALID_TRANSFORM",
        "/edits/0/T_object_scene/0/0",
    ),
    "a webhook that is not allowed": (
        {"webhook": {"url": "https://elsewhere.example/"}},
        "WEBHOOK_NOT_ALLOWED",
        "/webhook/url",
    ),
    "an object at no finite place": (
        {"edits": [EDIT | {"T_object_scene": [[2, 0, 0, 1e300], *MATRIX[1:]]}]},
        "INVALID_TRANSFORM",
        "/edits/0/T_object_scene/0/3",
    ),
}


@pytest.mark.parametrize(("change", "reason", "pointer"), BAD.values(), ids=BAD)
def test_refused(
    world: World, change: dict[str, Any], reason: str, pointer: str, nothing_of_a_request_stays: None
) -> None:
    scene = world.valid_request()["scene"]
    answer = post(world, {"scene": scene, "size": [64, 48]} | change)
    problem = assert_refused(answer, REASONS[reason].status, reason)
    pointers = [one["pointer"] for one in problem.get("errors", [])]
    assert pointer in pointers or (pointer == "" and not any(pointers)), problem


def post(world: World, body: Any, **headers: str) -> Any:
    return bad_input.post(world, body, address="/render", **headers)


@pytest.mark.parametrize("body", [b"", b"[]", b"null", b"{", b'{"scene": 1}', b"\xff"])
def test_bodies_that_are_no_request(world: World, body: bytes, nothing_of_a_request_stays: None) -> None:
    answer = post(world, body)
    assert answer.status_code in (400, 422), answer.text
    assert_refused(answer, answer.status_code, answer.json()["reason"])


def test_only_json_is_taken(world: World, nothing_of_a_request_stays: None) -> None:
    answer = world.client.post("/render", files={"scene": b"x"})
    assert_refused(answer, 415, "UNSUPPORTED_MEDIA_TYPE")


def test_a_rejected_object_is_refused(world: World) -> None:
    scene, object_ = world.valid_request()["scene"], world.rejected_field("a broken chair")
    answer = post(world, {"scene": scene, "edits": [EDIT | {"object": object_}, {"kind": "removal", "detection": BOX}]})
    problem = assert_refused(answer, 422, "FIELD_REJECTED")
    assert problem["errors"][0]["pointer"] == "/edits/0/object"
