"""Requests that are refused: the reason, the place, nothing left behind, and the next good one works.

What a person writes by mistake is in tests/mistakes; here is what a program may send.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from redis import Redis

from tests.contract.conftest import post
from tests.contract.world import BOX, NOBODY, World, assert_refused, make_world, pointers

stays = pytest.mark.usefixtures("nothing_of_a_request_stays")
IDENTITY = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
NAN, INF = float("nan"), float("inf")
UNIT: dict[str, Any] = {"center": [0, 0, 0], "size": [1, 1, 1]}


def rows(*changes: tuple[int, int, Any]) -> Any:
    changed = [list(row) for row in IDENTITY]
    for row, column, value in changes:
        changed[row][column] = value
    return changed


def unit(**changes: Any) -> dict[str, Any]:
    return UNIT | changes


MEMBERS: dict[str, tuple[str, list[tuple[Any, str]]]] = {
    "detection": ("INVALID_DETECTION", [
        (None, ""), ([], ""), ([BOX], ""), ({}, "/center"), ("the chair", ""), (unit(yaw=1), "/yaw"),
        (unit(id=1), "/id"),
        (unit(center=[NAN, 0, 0]), "/center/0"), (unit(center=[0, INF, 0]), "/center/1"),
        (unit(center=[0, 0, -INF]), "/center/2"), (unit(center=[1e308, 0, 0]), "/center/0"),
        (unit(center=[10**400, 0, 0]), "/center/0"), (unit(center=["0", 0, 0]), "/center/0"),
        (unit(center=[True, 0, 0]), "/center/0"), (unit(center=[None, 0, 0]), "/center/0"),
        (unit(center=[0, 0]), "/center"), (unit(center=[0, 0, 0, 0]), "/center"),
        (unit(size=[1, 0, 1]), "/size/1"), (unit(size=[1, -1, 1]), "/size/1"), (unit(size=[1, 1, NAN]), "/size/2"),
        (unit(rotation_quaternion_xyzw=[0, 0, 0, 0]), "/rotation_quaternion_xyzw"),
        (unit(rotation_quaternion_xyzw=[0, 0, 1]), "/rotation_quaternion_xyzw"),
        (unit(rotation_quaternion_xyzw=[0, 0, 0, 1e308]), "/rotation_quaternion_xyzw/3"),
        (unit(rotation=[[1, 0, 0], [0, 1, 0], [0, 0, -1]]), "/rotation"),
        (unit(score=1.5), "/score"), (unit(score=-0.1), "/score"), (unit(score=True), "/score"),
        (unit(score=NAN), "/score"),
        (unit(label=""), "/label"), (unit(label="a" * 201), "/label"), (unit(label="a\r\nX-Bad: 1"), "/label"),
        (unit(label="a\u202eb"), "/label"), (unit(label="a\0b"), "/label"),
        ({"min": [0, 0, 0], "max": [1, 0, 1]}, "/max/1"), ({"min": [0, 0, 0]}, "/max"),
        (unit(min=[0, 0, 0], max=[1, 1, 1]), "/center"),
    ]),
    "options": ("INVALID_OPTIONS", [
        (None, ""), ({"sampling": {"unknown": 1}}, "/sampling/unknown"), ({"up_axis": "w"}, "/up_axis"),
        *(({"sampling": {"views": value}}, "/sampling/views") for value in (0, -1, 10**9, "5", True, 5.5)),
        ({"sampling": {"scene_camera_distance": NAN}}, "/sampling/scene_camera_distance"),
        ({"optimization": {"iterations": 10**12}}, "/optimization/iterations"),
        ({"optimization": {"translation_rate": INF}}, "/optimization/translation_rate"),
        ({"optimization": []}, "/optimization"),
    ]),
    "initial_transform": ("INVALID_TRANSFORM", [
        (rows((0, 3, NAN)), "/0/3"),
        *((rows((1, 1, value)), "/1/1") for value in (INF, 10**400, "1", True, None)),
        (rows((2, 2, -1)), ""), (rows((0, 1, 2e-4)), ""), (rows((0, 0, 1.001)), ""), (rows((3, 3, 2)), ""),
        (rows((0, 0, 0), (1, 1, 0), (2, 2, 0)), ""), (rows((3, 0, 0.1)), ""), ([row[:3] for row in IDENTITY], "/0"),
        ([], ""), ([*range(16)], ""), ("identity", ""), (7, ""), ({}, "/matrix"), ({"matrix": None}, "/matrix"),
        ({"matrix": rows((2, 2, -1))}, "/matrix"), ({"matrix": IDENTITY, "scale": 2}, ""),
        ({"matrix": IDENTITY, "scale": 0}, "/scale"), ({"matrix": IDENTITY, "translation": [0, 0, 1]}, ""),
        ({"matrix": IDENTITY, "rotation_quaternion_xyzw": [0, 0, 1, 0]}, ""),
        ({"matrix": IDENTITY, "rotation_quaternion_xyzw": [0, 0, 0, 0]}, ""),
        ({"matrix": IDENTITY, "more": 1}, "/more"),
        ({"T_object_scene": IDENTITY[:3]}, "/T_object_scene"),
        ({"T_scene_object": {"matrix": IDENTITY, "scale": 2}}, "/T_scene_object"),
        ({"T_scene_object": IDENTITY, "T_object_scene": IDENTITY}, ""),
        ({"T_scene_object": IDENTITY, "matrix": IDENTITY}, "/matrix"),
    ]),
    "ground_truth": ("INVALID_TRANSFORM", [
        ({"T_object_scene": rows((2, 2, -1))}, "/T_object_scene"),
        ({"T_object_scene": rows((0, 3, 1e308))}, "/T_object_scene/0/3"),
        ({"T_scene_object": None}, ""), ({"T_scene_object": IDENTITY, "T_object_scene": IDENTITY}, ""),
        ({}, ""), (IDENTITY, ""),
    ]),
    "seed": ("INVALID_REQUEST", [(value, "") for value in (2**32, 2**64, 1.5, True, None)]),
    "scene": ("INVALID_REQUEST", [("../" * 20 + "aaaa", ""), ({"field": "a" * 64, "more": 1}, "")]),
    "object": ("INVALID_REQUEST", [(None, "")]),
}  # fmt: skip


@stays
@pytest.mark.parametrize("member", MEMBERS)
def test_a_member_that_is_wrong_is_pointed_at(world: World, member: str) -> None:
    reason, wrong = MEMBERS[member]
    good = world.valid_request()
    for value, below in wrong:
        problem = assert_refused(post(world, good | {member: value}), 422, reason)
        assert f"/{member}{below}" in pointers(problem), (value, problem)
        if member == "detection":
            assert problem["detail"].startswith("detection"), problem
            assert problem["detail"] == problem["errors"][0]["detail"]


@stays
def test_unknown_members_are_not_repeated(world: World) -> None:
    answer = post(world, world.valid_request() | {"<script>": 1})
    assert pointers(assert_refused(answer, 422, "INVALID_REQUEST")) == [""]
    assert "script" not in answer.text


@stays
def test_the_part_that_is_no_json_is_named(world: World) -> None:
    parts = {"description": (None, "up z"), "file": ("a.glb", b"glTF")}
    problem = assert_refused(world.client.post("/fields", files=parts), 400, "MALFORMED_JSON")
    assert problem["detail"] == "The part `description` is not JSON from line 1, column 1 on."


CENTER, SIZE = [-0.125, -0.0625, 0.25], [0.5, 0.25, 0.125]
LOW, HIGH = [-0.375, -0.1875, 0.1875], [0.125, 0.0625, 0.3125]
"""The same box, without rounding."""


@stays
def test_every_form_of_a_box_is_one_job(world: World) -> None:
    forms: list[Any] = [
        {"center": CENTER, "size": SIZE},
        {"center": CENTER, "extent": SIZE, "R": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]},
        {"min_bound": LOW, "max_bound": HIGH},
        {"center": dict(zip("xyz", CENTER, strict=True)), "size": dict(zip("xyz", SIZE, strict=True))},
        {"center": CENTER, "size": SIZE, "rotation_quaternion_wxyz": [-2, 0, 0, 0]},
    ]
    answers = [post(world, world.valid_request() | {"detection": form}, "/register?dry_run=true") for form in forms]
    assert [answer.status_code for answer in answers] == [200] * len(forms)
    assert [answer.json() for answer in answers] == [answers[0].json()] * len(forms)


@stays
def test_a_box_wholly_outside_the_scene(world: World) -> None:
    for box in (
        {"min": [1.1, 0, 0], "max": [1.2, 1, 1]},
        {"center": [-1500.0, 50.0, 200.0], "size": [500.0, 20.0, 40.0]},
        # its corner points at the scene's corner, but stays short of it: only a slanted axis tells
        unit(center=[1.8, 1.8, 0], rotation_quaternion_xyzw=[0, 0, 0.38268343, 0.92387953]),
    ):
        refused = post(world, world.valid_request() | {"detection": box})
        assert "from the scene's bounds" in assert_refused(refused, 422, "DETECTION_OUTSIDE_SCENE")["detail"]


def searching(world: World, **changes: Any) -> dict[str, Any]:
    """A good search among one object, with changes; a member that is `...` is left out."""
    request = world.valid_request()
    body = {"scene": request["scene"], "detection": BOX, "candidates": [request["object"]]} | changes
    return {name: value for name, value in body.items() if value is not ...}


A, B = "a3" * 32, "7c" * 32


@stays
def test_candidates(world: World) -> None:
    wrong: list[tuple[dict[str, Any], str]] = [
        ({"candidates": ...}, ""), ({"object": B}, ""), ({"ground_truth": {"T_object_scene": IDENTITY}}, "/candidates"),
        *(({"candidates": value}, "/candidates") for value in ([], None, A, [A, B, A], [A, {"field": A}])),
        ({"candidates": [A, "A" * 64]}, "/candidates/1"), ({"candidates": [A, None]}, "/candidates/1"),
        ({"candidates": [[A]]}, "/candidates/0"),
        ({"candidates": [f"{number:064x}" for number in range(513)]}, "/candidates"),
    ]  # fmt: skip
    for change, pointer in wrong:
        problem = assert_refused(post(world, searching(world, **change)), 422, "INVALID_REQUEST")
        assert pointer in pointers(problem), (change, problem)
    known, rejected = world.valid_request()["object"], world.rejected_field("broken")
    problem = assert_refused(post(world, searching(world, candidates=[A, known, B])), 404, "FIELD_NOT_FOUND")
    assert pointers(problem) == ["/candidates/0", "/candidates/2"]
    assert_refused(post(world, searching(world, candidates=[known], scene=A)), 404, "FIELD_NOT_FOUND")
    problem = assert_refused(post(world, searching(world, candidates=[known, rejected])), 422, "FIELD_REJECTED")
    assert pointers(problem) == ["/candidates/1"]


@stays
def test_what_does_not_go_together(world: World) -> None:
    """The published method searches no library and starts from no transform; a search starts from none either."""
    paper, start = {"options": {"preset": "paper"}}, {"initial_transform": IDENTITY}
    one = world.valid_request()
    problem = assert_refused(post(world, one | paper | start), 422, "PRESET_UNSUITABLE")
    assert pointers(problem) == ["/initial_transform"]
    assert_refused(post(world, searching(world, **start)), 422, "PRESET_UNSUITABLE")
    assert_refused(post(world, searching(world, **paper)), 422, "PRESET_UNSUITABLE")
    assert_refused(post(world, one | start | {"options": {"preset": "fastest"}}), 422, "INVALID_OPTIONS")
    gone = assert_refused(post(world, one | {"options": {"robust": {"min_inlier_share": 0.5}}}), 422, "INVALID_OPTIONS")
    assert gone["hint"] == "Only the probability decides: see `robust.acceptance`"


@stays
def test_unknown_and_rejected_fields(world: World) -> None:
    for name in ("scene", "object"):
        problem = assert_refused(post(world, world.valid_request() | {name: "0" * 64}), 404, "FIELD_NOT_FOUND")
        assert pointers(problem) == [f"/{name}"]
    rejected = world.rejected_field("bad")
    problem = assert_refused(post(world, world.valid_request() | {"object": rejected}), 422, "FIELD_REJECTED")
    assert "FIELD_SHAPES_MISMATCH" in problem["errors"][0]["detail"]


BODIES = {
    "MALFORMED_JSON": (400, [
        b"{", b'{"seed": 1, "seed": 2}', b'{"detection": {"min": [], "min": []}}', b'{"a": "\xc3\xa4\xff"}',
        b'{"a": "\x81"}',
        b"\xff\xfe{", b'{"a": "\\ud800"}', b"[" * 4000, b"[" * 4000 + b"]" * 4000, b"[" * 40 + b"]" * 40,
        b'{"seed": ' + b"9" * 5000 + b"}",
    ]),
    "INVALID_REQUEST": (422, [b"null", b"[]", b'"x"']),
    "INVALID_DETECTION": (422, [  # in other encodings
        '{"seed": 1}'.encode("utf-16"), '{"seed": 1}'.encode("utf-16-le"), b"\xef\xbb\xbf{}", b'{"a": "\xff"}',
    ]),
    "REQUEST_TOO_LARGE": (413, [b"[" * 100_000 + b"]" * 100_000, b" " * (2 << 20)]),
}  # fmt: skip


@stays
@pytest.mark.parametrize("reason", BODIES)
def test_bodies(world: World, reason: str) -> None:
    for body in BODIES[reason][1]:
        problem = assert_refused(post(world, body), BODIES[reason][0], reason)
        assert reason != "INVALID_DETECTION" or problem["detail"] == "The member /detection is missing.", body


@stays
def test_a_body_of_fifty_megabytes_is_refused_by_count(world: World) -> None:
    pieces = (b" " * (1 << 20) for _ in range(50))
    answer = world.client.post("/register", content=pieces, headers={"Content-Type": "application/json"})
    assert_refused(answer, 413, "REQUEST_TOO_LARGE")


@stays
def test_headers(world: World) -> None:
    for kind in ("", "text/plain", "application/xml", "application/x-www-form-urlencoded"):
        answer = post(world, world.valid_request(), **{"Content-Type": kind})
        assert_refused(answer, 415, "UNSUPPORTED_MEDIA_TYPE")
    assert_refused(post(world, b"{}", **{"Content-Encoding": "gzip"}), 415, "UNSUPPORTED_MEDIA_TYPE")
    keys: list[Any] = ["", "k" * 256, "a\tb", "schl\u00fcssel".encode()]
    for key in keys:
        answer = world.client.post("/register", json=world.valid_request(), headers={"Idempotency-Key": key})
        assert_refused(answer, 400, "INVALID_HEADER")


FORGED = ("x", "", "!!!", "bnVsbA", "W10", "WzEsMl0", "W05hTiwiYSJd", "WzFlOTk5LCJhIl0", "W1tbW1tbW1tb")
"""Tokens of pages."""
QUERIES = [
    *(("/jobs/x", "wait", wait) for wait in ("99999", "-1", "31", "1.5", "soon", "true")),
    *((path, "limit", limit) for path in ("/jobs", "/fields") for limit in ("0", "-1", "201", "x")),
    *((path, "page_token", token) for path in ("/jobs", "/fields") for token in FORGED),
    *(("/jobs", "status", status) for status in ("done", "", "accepted,running")),
]


@stays
def test_queries(world: World) -> None:
    for path, name, value in QUERIES:
        problem = assert_refused(world.client.get(path, params={name: value}), 400, "INVALID_QUERY")
        assert name != "wait" or problem["errors"][0]["parameter"] == name, value
    assert_refused(post(world, world.valid_request(), "/register?dry_run=perhaps"), 400, "INVALID_QUERY")


@stays
def test_parameters_that_are_not_known_are_refused_but_by_pages_and_probes(world: World) -> None:
    for method, path, named, why in (
        ("POST", "/register?dryrun=true", "dryrun", "unknown"),
        ("POST", "/v1/register?dry_run=true&dry_run=false", "dry_run", "given twice"),
        ("GET", "/jobs?limits=1&limit=1", "limits", "unknown"),
        ("GET", f"/fields/{NOBODY * 2}?wait=0&Wait=1", "Wait", "unknown"),
        ("GET", "/fields?%0d%0aX=1", "", "unknown"),
        ("PUT", f"/fields/{NOBODY * 2}?label=chair", "label", "unknown"),
    ):
        answer = world.client.request(method, path, json=world.valid_request() if method == "POST" else None)
        assert assert_refused(answer, 400, "INVALID_QUERY")["errors"] == [{"parameter": named, "detail": why}]
    for path in ("/healthz?probe=1", "/docs?from=mail", "/v1/version?x"):
        assert world.client.get(path).status_code == 200


PAPER = {"preset": "paper"}
LONG = PAPER | {"optimization": {"iterations": 10_000}}
COSTLY: list[tuple[dict[str, Any], set[str]]] = [
    ({"sampling": {"views": 64, "image_size": 4096, "pixel_stride": 1}}, {"views", "image_size", "pixel_stride"}),
    ({"initialization": {"draws": 256, "ransac_iterations": 10_000_000}}, {"draws", "ransac_iterations"}),
    ({"optimization": {"iterations": 10_000, "samples_per_iteration": 1_000_000},
      "resampling": {"max_samples": 1_000_000, "every": 10_000}}, {"iterations", "samples_per_iteration"}),
    (LONG | {"resampling": {"every": 1, "max_samples": 1_000_000}}, {"iterations", "every", "max_samples"}),
]  # fmt: skip
"""Options of the published method that multiply to more memory or time than a job may have, and which they are."""


@stays
def test_options_whose_product_is_too_costly(world: World) -> None:
    for options, named in COSTLY:
        for path in ("/register", "/register?dry_run=true"):
            answer = post(world, world.valid_request() | {"options": PAPER | options}, path)
            problem = assert_refused(answer, 422, "OPTIONS_TOO_COSTLY")
            assert {pointer.rpartition("/")[2] for pointer in pointers(problem)} == named
            assert all("limit" in fault["detail"] for fault in problem["errors"])


def test_default_options_are_never_too_costly(any_redis: Redis, tmp_path: Path) -> None:
    """Nor is a product that a fast field does in time."""
    world = make_world(tmp_path, any_redis)
    assert post(world, world.valid_request() | {"options": LONG}).status_code == 202
    world.client.close()
    world = make_world(tmp_path, any_redis, job_timeout_s=1, job_memory_bytes=512 << 20)
    for preset in ("paper", "robust"):
        assert post(world, world.valid_request() | {"options": {"preset": preset}}).status_code == 202
    assert_refused(post(world, world.valid_request() | {"options": LONG}), 422, "OPTIONS_TOO_COSTLY")
    world.client.close()
