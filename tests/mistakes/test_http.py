# ruff: noqa: E501 -- a mistake is one line of a table
"""Requests that a new user of the HTTP interface sends by mistake: every refusal names, expects, and says what to do."""

from __future__ import annotations

import json
from typing import Any

import pytest

from tests.contract.world import BOX, World, assert_refused, field_bytes, sha256
from tests.mistakes.case import Case, parametrized

ANY = "0" * 64


def post(**changes: Any) -> dict[str, Any]:
    """POST /register with these members changed; None takes a member away."""
    return {"changes": changes}


CASES = [
    Case("short hash", "INVALID_REQUEST", 422, "/scene", "12 characters, expected 64", "sha256sum", post(scene="0123456789ab")),
    Case("upper-case hash", "INVALID_REQUEST", 422, "/scene", "uppercase letters, expected 64", "sha256sum", post(scene="AB" * 32)),
    Case("file name for a hash", "INVALID_REQUEST", 422, "/object", "9 characters, expected 64", "SHA-256", post(object="room.ckpt")),
    Case("unknown field", "FIELD_NOT_FOUND", 404, "/scene", "no such field", "Upload it", post(scene="12" * 32)),
    Case("no scene", "INVALID_REQUEST", 422, "/scene", "required", "errors", post(scene=None)),
    Case("no detection", "INVALID_DETECTION", 422, "/detection", "required", "docs/api.md", post(detection=None)),
    Case("object and candidates", "INVALID_REQUEST", 422, "candidates", "exactly one", "object", post(candidates=["12" * 32])),
    Case("misspelled member", "INVALID_REQUEST", 422, "/detections", "unknown", "Did you mean `detection`", post(detections=[BOX])),
    Case("spelling of earlier versions", "INVALID_OPTIONS", 422, "/options/initialisation", "[Nn]o such option", "Did you mean `initialization`", post(options={"initialisation": {}})),
    Case("typo in the preset", "INVALID_OPTIONS", 422, "/options/preset", "'paper' or 'robust'", "docs/api.md", post(options={"preset": "papr"})),
    Case("negative seed", "INVALID_REQUEST", 422, "/seed", "greater than or equal to 0", "errors", post(seed=-1)),
    Case("seed as a text", "INVALID_REQUEST", 422, "/seed", "integer", "errors", post(seed="0")),
    Case("misspelled member of the box", "INVALID_DETECTION", 422, "detection.cnter", "not a member", "Did you mean `center`", post(detection={"cnter": [0, 0, 0], "size": [1, 1, 1]})),
    Case("list of detections", "INVALID_DETECTION", 422, "a list of 2 detections", "expected one box", "entry without the list", post(detection=[BOX, BOX])),
    Case("millimeters", "DETECTION_OUTSIDE_SCENE", 422, "the box is 288 units from", "the scene reaches from", "millimeters", post(detection={"center": [-562, -283, -243], "size": [546, 598, 511]})),
    Case("transform of three rows", "INVALID_TRANSFORM", 422, "/initial_transform", "4", "(s R, t)", post(initial_transform=[[1, 0, 0, 0]] * 3)),
    Case("column-major transform", "INVALID_TRANSFORM", 422, "/initial_transform", "last row", "last row 0 0 0 1", post(initial_transform=[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [1, 2, 3, 1]])),
    Case("form instead of JSON", "UNSUPPORTED_MEDIA_TYPE", 415, "application/json", "Send application/json", "Send", {"content": b"scene=a", "headers": {"Content-Type": "application/x-www-form-urlencoded"}}),
    Case("no content type", "UNSUPPORTED_MEDIA_TYPE", 415, "application/json", "Send application/json", "Send", {"content": b"{}"}),
    Case("empty body", "MALFORMED_JSON", 400, "line 1, column 1", "not JSON", "It is empty", {"content": b"", "headers": {"Content-Type": "application/json"}}),
    Case("trailing comma", "MALFORMED_JSON", 400, "line 1, column 12", "not JSON", "Remove the comma", {"content": b'{"seed": 1,}', "headers": {"Content-Type": "application/json"}}),
    Case("parts without a boundary", "MALFORMED_MULTIPART", 400, "boundary|parts", "boundary|told apart", "curl -F", {"content": b"--x", "headers": {"Content-Type": "multipart/form-data"}}),
    Case("parts of other names", "MALFORMED_MULTIPART", 400, "part", "does not know|scene", "docs/api.md", {"files": {"file": ("a.ckpt", b"PK\x03\x04")}}),
    Case("a part is missing", "MALFORMED_MULTIPART", 400, "`request`", "missing", "docs/api.md", {"files": {"scene": ("a", field_bytes("a"))}}),
    Case("GET on a POST address", "METHOD_NOT_ALLOWED", 405, "/register", "methods of this address", "Allow", {"method": "GET"}),
    Case("address with a typo", "NOT_FOUND", 404, "/regsiter", "does not exist", "GET /", {"path": "/regsiter"}),
    Case("POST to a field's address", "METHOD_NOT_ALLOWED", 405, "/fields/0", "methods of this address", "Allow", {"path": f"/fields/{ANY}", "content": b"PK\x03\x04"}),
    Case("upload under another hash", "DIGEST_MISMATCH", 400, f"/fields/{ANY}", "digest", "sha256sum", {"method": "PUT", "path": f"/fields/{ANY}", "content": field_bytes("a")}),
    Case("upload under a file's name", "INVALID_DIGEST", 400, "/fields/room.ckpt", "64 lower-case", "sha256sum", {"method": "PUT", "path": "/fields/room.ckpt", "content": field_bytes("a")}),
    Case("empty upload", "UPLOAD_INCOMPLETE", 400, "/fields", "upload is empty", "curl --data-binary", {"path": "/fields", "content": b""}),
    Case("upload of a picture", "FIELD_NOT_RECOGNIZED", 415, "a PNG picture", "expected a field", "docs/import-gate.md", {"path": "/fields", "content": b"\x89PNG\r\n\x1a\n" + bytes(600)}),
    Case("upload of a Git LFS pointer", "FIELD_NOT_RECOGNIZED", 415, "Git LFS pointer", "not the file itself", "git lfs pull", {"path": "/fields", "content": b"version https://git-lfs.github.com/spec/v1\n" + bytes(600)}),
    Case("upload of JSON", "FIELD_NOT_RECOGNIZED", 415, "The file is", "supported", "docs/import-gate.md", {"path": "/fields", "content": json.dumps({"a": [0.5] * 200}).encode()}),
    Case("job of no such id", "JOB_NOT_FOUND", 404, "/jobs/x", "unknown|deleted", "GET /jobs", {"method": "GET", "path": "/jobs/x"}),
    Case("unknown query parameter", "INVALID_QUERY", 400, "parameters", "unknown", "errors", {"path": "/register?dryrun=true"}),
]  # fmt: skip


@parametrized(CASES)
def test_a_wrong_request(case: Case, world: World) -> None:
    how = {"method": "POST", "path": "/register"} | case.how
    if "changes" in how:
        request = {
            name: value for name, value in (world.valid_request() | how.pop("changes")).items() if value is not None
        }
        how["json"] = request
    answer = world.client.request(how.pop("method"), how.pop("path"), **how)
    problem = assert_refused(answer, case.code, case.reason)
    told = {name: problem.get(name) for name in ("detail", "hint", "errors", "instance")}
    case.check(json.dumps(told, ensure_ascii=False))


def test_what_is_not_ready(world: World) -> None:
    job = world.submit()
    answer = world.client.get(f"/jobs/{job}/result")
    problem = assert_refused(answer, 409, "JOB_NOT_READY")
    Case("", "", 409, job, "no result yet", "Retry after").check(json.dumps(problem))
    assert answer.headers["retry-after"]
    scene = world.rejected_field("bad")
    problem = assert_refused(
        world.client.post("/register", json=world.valid_request() | {"scene": scene}), 422, "FIELD_REJECTED"
    )
    Case("", "", 422, "/scene", "rejected: FIELD_SHAPES_MISMATCH", "GET /fields").check(json.dumps(problem))


def test_a_field_that_is_still_validating_is_waited_for(world: World) -> None:
    """No mistake: the job is accepted, and its worker checks the box."""
    request = world.valid_request()
    data = field_bytes("late")
    assert world.client.put(f"/fields/{sha256(data)}", content=data).json()["state"] == "validating"
    assert world.client.post("/register", json=request | {"scene": sha256(data)}).status_code == 202


def test_a_missing_token(tmp_path: Any, any_redis: Any) -> None:
    from tests.contract.world import make_world

    guarded = make_world(tmp_path / "guarded", any_redis, api_tokens=frozenset({"robot:open-sesame-open-sesame-1234"}))
    with guarded.client as client:
        for headers in ({}, {"Authorization": "Bearer wrong"}, {"Authorization": "open-sesame-open-sesame-1234"}):
            problem = assert_refused(client.get("/jobs", headers=headers), 401, "UNAUTHENTICATED")
            Case("", "", 401, "/jobs", "token", "Authorization: Bearer").check(json.dumps(problem))


@pytest.mark.parametrize("place", ["scene", "object"])
def test_scene_and_object_may_be_one_field(world: World, place: str) -> None:
    """Odd, and sometimes meant: no refusal."""
    request = world.valid_request()
    assert world.client.post("/register", json=request | {place: request["scene"]}).status_code == 202
