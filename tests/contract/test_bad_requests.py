"""Registration requests that are refused: the reason, the pointer, nothing left behind, and the next one works."""

from __future__ import annotations

from typing import Any

import pytest

from tests.contract.bad_input import post
from tests.contract.world import BOX, NOBODY, World, assert_refused

pytestmark = pytest.mark.usefixtures("nothing_of_a_request_stays")
IDENTITY = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


def matrix(*changes: tuple[int, int, Any]) -> dict[str, Any]:
    rows = [list(row) for row in IDENTITY]
    for row, column, value in changes:
        rows[row][column] = value
    return {"T_object_scene": rows}


@pytest.mark.parametrize(
    ("options", "pointer"),
    [
        pytest.param(None, "/options", id="null"),
        pytest.param({"unknown": 1}, "/options/unknown", id="unknown"),
        pytest.param({"sampling": {"unknown": 1}}, "/options/sampling/unknown", id="unknown below"),
        pytest.param({"preset": "fastest"}, "/options/preset", id="unknown preset"),
        pytest.param({"sampling": {"views": 0}}, "/options/sampling/views", id="zero"),
        pytest.param({"sampling": {"views": -1}}, "/options/sampling/views", id="negative"),
        pytest.param({"sampling": {"views": 10**9}}, "/options/sampling/views", id="huge"),
        pytest.param({"sampling": {"views": "5"}}, "/options/sampling/views", id="a string"),
        pytest.param({"sampling": {"views": True}}, "/options/sampling/views", id="a boolean"),
        pytest.param({"sampling": {"views": 5.5}}, "/options/sampling/views", id="a fraction"),
        pytest.param({"up_axis": "w"}, "/options/up_axis", id="unknown axis"),
        pytest.param(
            {"sampling": {"scene_camera_distance": float("nan")}}, "/options/sampling/scene_camera_distance", id="NaN"
        ),
        pytest.param(
            {"optimization": {"iterations": 10**12}}, "/options/optimization/iterations", id="huge iterations"
        ),
        pytest.param(
            {"optimization": {"translation_rate": float("inf")}}, "/options/optimization/translation_rate", id="Inf"
        ),
        pytest.param({"optimization": []}, "/options/optimization", id="a list"),
    ],
)
def test_options(world: World, options: Any, pointer: str) -> None:
    problem = assert_refused(post(world, world.valid_request() | {"options": options}), 422, "INVALID_OPTIONS")
    assert pointer in [entry["pointer"] for entry in problem["errors"]]


def test_a_member_that_is_missing_is_not_called_malformed(world: World) -> None:
    good = world.valid_request()
    problem = assert_refused(
        post(world, {name.title(): value for name, value in good.items()}), 422, "INVALID_DETECTION"
    )
    assert problem["detail"] == "The member /detection is missing."
    assert problem["hint"] == "Did you mean `scene`?"


def test_the_part_that_is_no_json_is_named(world: World) -> None:
    parts = {"description": (None, "up z"), "file": ("a.glb", b"glTF")}
    problem = assert_refused(world.client.post("/fields", files=parts), 400, "MALFORMED_JSON")
    assert problem["detail"] == "The part `description` is not JSON from line 1, column 1 on."


def test_an_unknown_option_is_answered_with_the_one_that_was_meant(world: World) -> None:
    body = world.valid_request() | {"options": {"robust": {"up_axis": "z"}}}
    (fault,) = assert_refused(post(world, body), 422, "INVALID_OPTIONS")["errors"]
    assert fault["pointer"] == "/options/robust/up_axis"
    assert "did you mean `up_axis`?" in fault["detail"]


@pytest.mark.parametrize(
    "truth",
    [
        matrix((2, 2, -1)),
        matrix((0, 0, 2)),
        matrix((0, 1, 0.5)),
        matrix((3, 3, 2)),
        matrix((3, 0, 1)),
        matrix((0, 3, float("nan"))),
        matrix((0, 3, 1e308)),
        matrix((0, 0, True)),
        matrix((0, 0, 0), (1, 1, 0), (2, 2, 0)),
        {"T_object_scene": IDENTITY[:3]},
        {"T_object_scene": [row[:3] for row in IDENTITY]},
        {"T_scene_object": IDENTITY[:3]},
        {"T_scene_object": None},
        {"T_scene_object": IDENTITY, "T_object_scene": IDENTITY},
        {},
        IDENTITY,
    ],
)
def test_transforms(world: World, truth: Any) -> None:
    assert_refused(post(world, world.valid_request() | {"ground_truth": truth}), 422, "INVALID_TRANSFORM")


def rows(*changes: tuple[int, int, Any]) -> Any:
    return matrix(*changes)["T_object_scene"]


@pytest.mark.parametrize(
    ("start", "pointer"),
    [
        (rows((0, 3, float("nan"))), "/initial_transform/0/3"),
        (rows((1, 1, float("inf"))), "/initial_transform/1/1"),
        (rows((1, 1, 10**400)), "/initial_transform/1/1"),
        (rows((1, 1, "1")), "/initial_transform/1/1"),
        (rows((1, 1, True)), "/initial_transform/1/1"),
        (rows((1, 1, None)), "/initial_transform/1/1"),
        (rows((2, 2, -1)), "/initial_transform"),
        (rows((0, 1, 2e-4)), "/initial_transform"),
        (rows((0, 0, 1.001)), "/initial_transform"),
        (rows((0, 0, 0), (1, 1, 0), (2, 2, 0)), "/initial_transform"),
        (rows((3, 3, 2)), "/initial_transform"),
        (rows((3, 0, 0.1)), "/initial_transform"),
        (IDENTITY[:3], "/initial_transform"),
        ([row[:3] for row in IDENTITY], "/initial_transform/0"),
        ([], "/initial_transform"),
        ([value for row in IDENTITY for value in row], "/initial_transform"),
        ("identity", "/initial_transform"),
        (7, "/initial_transform"),
        ({}, "/initial_transform/matrix"),
        ({"matrix": None}, "/initial_transform/matrix"),
        ({"matrix": rows((2, 2, -1))}, "/initial_transform/matrix"),
        ({"matrix": IDENTITY, "scale": 2}, "/initial_transform"),
        ({"matrix": IDENTITY, "scale": 0}, "/initial_transform/scale"),
        ({"matrix": IDENTITY, "translation": [0, 0, 1]}, "/initial_transform"),
        ({"matrix": IDENTITY, "rotation_quaternion_xyzw": [0, 0, 1, 0]}, "/initial_transform"),
        ({"matrix": IDENTITY, "rotation_quaternion_xyzw": [0, 0, 0, 0]}, "/initial_transform"),
        ({"matrix": IDENTITY, "more": 1}, "/initial_transform/more"),
        ({"T_object_scene": IDENTITY[:3]}, "/initial_transform/T_object_scene"),
        ({"T_scene_object": {"matrix": IDENTITY, "scale": 2}}, "/initial_transform/T_scene_object"),
        ({"T_scene_object": IDENTITY, "T_object_scene": IDENTITY}, "/initial_transform"),
        ({"T_scene_object": IDENTITY, "matrix": IDENTITY}, "/initial_transform/matrix"),
    ],
)
def test_initial_transforms(world: World, start: Any, pointer: str) -> None:
    body = world.valid_request() | {"initial_transform": start}
    problem = assert_refused(post(world, body), 422, "INVALID_TRANSFORM")
    assert pointer in [entry["pointer"] for entry in problem["errors"]]


def test_the_published_method_takes_no_initial_transform(world: World) -> None:
    body = world.valid_request() | {"initial_transform": IDENTITY, "options": {"preset": "paper"}}
    problem = assert_refused(post(world, body), 422, "PRESET_UNSUITABLE")
    assert [entry["pointer"] for entry in problem["errors"]] == ["/initial_transform"]


def searching(world: World, **changes: Any) -> dict[str, Any]:
    """A good search among one object, with changes; a member that is `...` is left out."""
    request = world.valid_request()
    body = {"scene": request["scene"], "detection": BOX, "candidates": [request["object"]]} | changes
    return {name: value for name, value in body.items() if value is not ...}


@pytest.mark.parametrize(
    ("change", "pointer"),
    [
        ({"candidates": ...}, ""),
        ({"object": "7c" * 32}, ""),
        ({"candidates": []}, "/candidates"),
        ({"candidates": None}, "/candidates"),
        ({"candidates": "a3" * 32}, "/candidates"),
        ({"candidates": ["a3" * 32, "A" * 64]}, "/candidates/1"),
        ({"candidates": ["a3" * 32, None]}, "/candidates/1"),
        ({"candidates": [["a3" * 32]]}, "/candidates/0"),
        ({"candidates": ["a3" * 32, "7c" * 32, "a3" * 32]}, "/candidates"),
        ({"candidates": ["a3" * 32, {"field": "a3" * 32}]}, "/candidates"),
        ({"candidates": [f"{number:064x}" for number in range(513)]}, "/candidates"),
        ({"ground_truth": matrix()}, "/candidates"),
    ],
)
def test_candidates(world: World, change: dict[str, Any], pointer: str) -> None:
    problem = assert_refused(post(world, searching(world, **change)), 422, "INVALID_REQUEST")
    assert pointer in [entry["pointer"] for entry in problem["errors"]]


def test_candidates_that_are_not_there_are_named_by_their_place(world: World) -> None:
    known = world.valid_request()["object"]
    names = ["a3" * 32, known, "7c" * 32]
    problem = assert_refused(post(world, searching(world, candidates=names)), 404, "FIELD_NOT_FOUND")
    assert [entry["pointer"] for entry in problem["errors"]] == ["/candidates/0", "/candidates/2"]
    assert_refused(post(world, searching(world, candidates=[known], scene="a3" * 32)), 404, "FIELD_NOT_FOUND")


def test_a_rejected_candidate_is_refused(world: World) -> None:
    rejected = world.rejected_field("broken")
    names = [world.valid_request()["object"], rejected]
    problem = assert_refused(post(world, searching(world, candidates=names)), 422, "FIELD_REJECTED")
    assert [entry["pointer"] for entry in problem["errors"]] == ["/candidates/1"]


def test_the_published_method_searches_no_library(world: World) -> None:
    body = searching(world, options={"preset": "paper"})
    assert_refused(post(world, body), 422, "PRESET_UNSUITABLE")


def test_a_search_starts_from_no_given_transform(world: World) -> None:
    assert_refused(post(world, searching(world, initial_transform=IDENTITY)), 422, "PRESET_UNSUITABLE")


def test_of_an_unusable_preset_and_an_initial_transform_the_preset_is_refused(world: World) -> None:
    body = world.valid_request() | {"initial_transform": IDENTITY, "options": {"preset": "fastest"}}
    assert_refused(post(world, body), 422, "INVALID_OPTIONS")


@pytest.mark.parametrize(
    ("change", "pointer"),
    [
        pytest.param({"seed": -1}, "/seed", id="seed -1"),
        pytest.param({"seed": 2**32}, "/seed", id="seed 2^32"),
        pytest.param({"seed": 2**64}, "/seed", id="seed 2^64"),
        pytest.param({"seed": 1.5}, "/seed", id="seed a fraction"),
        pytest.param({"seed": "1"}, "/seed", id="seed a string"),
        pytest.param({"seed": True}, "/seed", id="seed a boolean"),
        pytest.param({"seed": None}, "/seed", id="seed null"),
        pytest.param({"scene": "abc"}, "/scene", id="no hash"),
        pytest.param({"scene": "A" * 64}, "/scene", id="upper-case hash"),
        pytest.param({"scene": "../" * 20 + "aaaa"}, "/scene", id="traversal for a hash"),
        pytest.param({"scene": {"field": "a" * 64, "more": 1}}, "/scene", id="an odd reference"),
        pytest.param({"object": None}, "/object", id="null"),
        pytest.param({"unknown": 1}, "/unknown", id="unknown field"),
        pytest.param({"<script>": 1}, "", id="a script"),
    ],
)
def test_requests(world: World, change: dict[str, Any], pointer: str) -> None:
    answer = post(world, world.valid_request() | change)
    problem = assert_refused(answer, 422, "INVALID_REQUEST")
    assert pointer in [entry["pointer"] for entry in problem["errors"]]
    assert "script" not in answer.text


@pytest.mark.parametrize(
    ("body", "status", "reason"),
    [
        pytest.param(b"", 400, "MALFORMED_JSON", id="empty"),
        pytest.param(b"{", 400, "MALFORMED_JSON", id="cut short"),
        pytest.param(b"null", 422, "INVALID_REQUEST", id="null"),
        pytest.param(b"[]", 422, "INVALID_REQUEST", id="a list"),
        pytest.param(b'"x"', 422, "INVALID_REQUEST", id="a string"),
        pytest.param(b'{"seed": 1, "seed": 2}', 400, "MALFORMED_JSON", id="duplicate key"),
        pytest.param(b'{"detection": {"min": [], "min": []}}', 400, "MALFORMED_JSON", id="duplicate key below"),
        pytest.param('{"seed": 1}'.encode("utf-16"), 422, "INVALID_DETECTION", id="UTF-16"),
        pytest.param('{"seed": 1}'.encode("utf-16-le"), 422, "INVALID_DETECTION", id="UTF-16 without a mark"),
        pytest.param(b"\xef\xbb\xbf{}", 422, "INVALID_DETECTION", id="a byte order mark"),
        pytest.param(b'{"a": "\xff"}', 422, "INVALID_DETECTION", id="Windows-1252"),
        pytest.param(b'{"a": "\xc3\xa4\xff"}', 400, "MALFORMED_JSON", id="damaged UTF-8"),
        pytest.param(b'{"a": "\x81"}', 400, "MALFORMED_JSON", id="no UTF-8"),
        pytest.param(b"\xff\xfe{", 400, "MALFORMED_JSON", id="half a character of UTF-16"),
        pytest.param(b'{"a": "\\ud800"}', 400, "MALFORMED_JSON", id="half a surrogate pair"),
        pytest.param(b"[" * 4000, 400, "MALFORMED_JSON", id="deep, without end"),
        pytest.param(b"[" * 4000 + b"]" * 4000, 400, "MALFORMED_JSON", id="deep"),
        pytest.param(b"[" * 100_000 + b"]" * 100_000, 413, "REQUEST_TOO_LARGE", id="deeper"),
        pytest.param(b"[" * 40 + b"]" * 40, 400, "MALFORMED_JSON", id="nested 40 times"),
        pytest.param(b'{"seed": ' + b"9" * 5000 + b"}", 400, "MALFORMED_JSON", id="5000 digits"),
        pytest.param(b" " * (2 << 20), 413, "REQUEST_TOO_LARGE", id="2 MB"),
    ],
)
def test_bodies(world: World, body: bytes, status: int, reason: str) -> None:
    assert_refused(post(world, body), status, reason)


def test_a_body_of_fifty_megabytes_is_refused_by_count(world: World) -> None:
    pieces = (b" " * (1 << 20) for _ in range(50))
    answer = world.client.post("/register", content=pieces, headers={"Content-Type": "application/json"})
    assert_refused(answer, 413, "REQUEST_TOO_LARGE")


@pytest.mark.parametrize("kind", ["", "text/plain", "application/xml", "application/x-www-form-urlencoded"])
def test_other_media_types_are_refused(world: World, kind: str) -> None:
    answer = post(world, world.valid_request(), **{"Content-Type": kind})
    assert_refused(answer, 415, "UNSUPPORTED_MEDIA_TYPE")


def test_compressed_bodies_are_refused(world: World) -> None:
    assert_refused(post(world, b"{}", **{"Content-Encoding": "gzip"}), 415, "UNSUPPORTED_MEDIA_TYPE")


@pytest.mark.parametrize("key", ["", "k" * 256, "a\tb", "schl\u00fcssel".encode()])
def test_idempotency_keys(world: World, key: Any) -> None:
    answer = world.client.post("/register", json=world.valid_request(), headers={"Idempotency-Key": key})
    assert_refused(answer, 400, "INVALID_HEADER")


def test_unknown_and_rejected_fields(world: World) -> None:
    for name in ("scene", "object"):
        problem = assert_refused(post(world, world.valid_request() | {name: "0" * 64}), 404, "FIELD_NOT_FOUND")
        assert problem["errors"][0]["pointer"] == f"/{name}"
    rejected = world.rejected_field("bad")
    problem = assert_refused(post(world, world.valid_request() | {"object": rejected}), 422, "FIELD_REJECTED")
    assert "FIELD_SHAPES_MISMATCH" in problem["errors"][0]["detail"]


@pytest.mark.parametrize("wait", ["99999", "-1", "31", "1.5", "soon", "true"])
def test_waits_beyond_reason(world: World, wait: str) -> None:
    problem = assert_refused(world.client.get(f"/jobs/x?wait={wait}"), 400, "INVALID_QUERY")
    assert problem["errors"][0]["parameter"] == "wait"


@pytest.mark.parametrize("limit", ["0", "-1", "201", "x"])
def test_limits_beyond_reason(world: World, limit: str) -> None:
    for path in ("/jobs", "/fields"):
        assert_refused(world.client.get(path, params={"limit": limit}), 400, "INVALID_QUERY")


@pytest.mark.parametrize(
    "token", ["x", "", "!!!", "bnVsbA", "W10", "WzEsMl0", "W05hTiwiYSJd", "WzFlOTk5LCJhIl0", "W1tbW1tbW1tb"]
)
def test_forged_page_tokens(world: World, token: str) -> None:
    for path in ("/jobs", "/fields"):
        assert_refused(world.client.get(path, params={"page_token": token}), 400, "INVALID_QUERY")


@pytest.mark.parametrize("status", ["done", "", "accepted,running"])
def test_unknown_states(world: World, status: str) -> None:
    assert_refused(world.client.get("/jobs", params={"status": status}), 400, "INVALID_QUERY")


def test_dry_run_is_yes_or_no(world: World) -> None:
    answer = world.client.post("/register?dry_run=perhaps", json=world.valid_request())
    assert_refused(answer, 400, "INVALID_QUERY")


@pytest.mark.parametrize(
    ("method", "path", "named", "why"),
    [
        ("POST", "/register?dryrun=true", "dryrun", "unknown"),
        ("POST", "/v1/register?dry_run=true&dry_run=false", "dry_run", "given twice"),
        ("GET", "/jobs?limits=1&limit=1", "limits", "unknown"),
        ("GET", f"/fields/{NOBODY * 2}?wait=0&Wait=1", "Wait", "unknown"),
        ("GET", "/fields?%0d%0aX=1", "", "unknown"),
        ("PUT", f"/fields/{NOBODY * 2}?label=chair", "label", "unknown"),
    ],
)
def test_parameters_that_are_not_known_are_refused(world: World, method: str, path: str, named: str, why: str) -> None:
    answer = world.client.request(method, path, json=world.valid_request() if method == "POST" else None)
    problem = assert_refused(answer, 400, "INVALID_QUERY")
    assert problem["errors"] == [{"parameter": named, "detail": why}]
    assert world.queue.registrations == []


@pytest.mark.parametrize("path", ["/healthz?probe=1", "/docs?from=mail", "/v1/version?x"])
def test_pages_and_probes_take_no_offence_at_parameters(world: World, path: str) -> None:
    assert world.client.get(path).status_code == 200
