"""Results and artifacts over HTTP."""

from __future__ import annotations

import re

import pytest
from prometheus_client import generate_latest

from regnf_state.reasons import REASONS
from tests.contract.world import RESULT, World, assert_refused

DATA = bytes(range(256)) * 4


@pytest.fixture
def job_id(world: World) -> str:
    made = world.submit()
    world.succeed(made, {"scene_points.ply": DATA, "trace.json": b"[]", "private.key": b"not an artifact"})
    return made


def test_the_result_lists_its_artifacts(world: World, job_id: str) -> None:
    document = world.client.get(f"/jobs/{job_id}/result").json()
    assert {name: document[name] for name in RESULT} == RESULT
    listed = {entry["name"]: entry for entry in document["artifacts"]}
    assert set(listed) == {"result.json", "scene_points.ply", "trace.json"}
    assert world.client.get(listed["scene_points.ply"]["url"]).content == DATA
    assert listed["scene_points.ply"]["bytes"] == len(DATA)


def test_a_result_larger_than_any_can_be_is_not_read_whole(world: World, job_id: str) -> None:
    world.blobs.put(f"jobs/{job_id}/1/result.json", b'{"a": "' + b"x" * (4 << 20) + b'"}')
    assert_refused(world.client.get(f"/jobs/{job_id}/result"), 503, "RECORD_UNREADABLE")


def test_pictures_follow_the_result(world: World) -> None:
    job_id = world.submit(seed=1)
    world.succeed(job_id, pending=["preview.png"])
    document = world.client.get(f"/jobs/{job_id}/result").json()
    listed = {entry["name"]: entry for entry in document["artifacts"]}
    picture = listed["preview.png"]
    assert (picture["state"], picture["bytes"], picture["sha256"]) == ("pending", None, None)
    assert listed["result.json"]["state"] == "ready"
    refused = world.client.get(picture["url"], params={"wait": 0})
    assert_refused(refused, 409, "ARTIFACT_NOT_READY")
    assert refused.headers["retry-after"] == "1"
    assert world.client.head(picture["url"], params={"wait": 0}).status_code == 409
    world.finish(job_id, {"preview.png": b"a picture"})
    assert world.client.get(picture["url"]).content == b"a picture"
    document = world.client.get(f"/jobs/{job_id}/result").json()
    assert [entry["state"] for entry in document["artifacts"]] == ["ready", "ready"]
    assert "missing_artifacts" not in document


def test_pictures_whose_worker_has_died_are_missing_in_time(world: World) -> None:
    job_id = world.submit(seed=1)
    world.succeed(job_id, pending=["preview.png"])
    world.records.ahead_s = world.settings.lost_after_s + 1
    document = world.client.get(f"/jobs/{job_id}/result").json()
    assert document["missing_artifacts"] == ["preview.png"]
    assert [entry["name"] for entry in document["artifacts"]] == ["result.json"]
    assert_refused(world.client.get(f"/jobs/{job_id}/artifacts/preview.png"), 404, "ARTIFACT_NOT_FOUND")


def test_a_result_comes_when_it_is_there_and_not_before(world: World) -> None:
    job_id = world.submit(seed=1)
    for path in ("result", "artifacts/trace.json"):
        answer = world.client.get(f"/jobs/{job_id}/{path}")
        assert_refused(answer, 409, "JOB_NOT_READY")
        assert answer.headers["retry-after"] == "1"


def test_a_failed_job_answers_with_its_own_problem(world: World) -> None:
    job_id = world.submit(seed=1)
    detail = "12 surface points were found; 500 are needed."
    world.fail(job_id, reason="NO_SURFACE_IN_DETECTION", title="No surface", status=422, detail=detail, found=12)
    problem = assert_refused(world.client.get(f"/jobs/{job_id}/result"), 409, "JOB_FAILED")
    assert problem["detail"] == f"NO_SURFACE_IN_DETECTION: {detail}"
    own = problem["error"]
    assert (own["reason"], own["status"], own["detail"], own["found"]) == ("NO_SURFACE_IN_DETECTION", 422, detail, 12)
    assert world.client.get(f"/jobs/{job_id}").json()["error"] == own


def test_a_reason_that_only_the_engine_knows_passes_through(world: World) -> None:
    job_id = world.submit(seed=1)
    world.fail(job_id, reason="SOMETHING_NEW", title="New", status=422, detail="never seen here")
    problem = assert_refused(world.client.get(f"/jobs/{job_id}/result"), 409, "JOB_FAILED")
    assert problem["error"]["reason"] == "SOMETHING_NEW"


@pytest.mark.parametrize("reason", ["WORKER_LOST", "JOB_TIMEOUT", "OUT_OF_MEMORY", "STORAGE_FULL", "INTERNAL"])
def test_polling_a_failed_job_is_no_error_of_the_server(world: World, reason: str) -> None:
    job_id = world.submit(seed=1)
    world.fail(job_id, reason=reason, title="Failed", status=REASONS[reason].status, detail="why")
    for path in ("result", "artifacts/trace.json"):
        assert_refused(world.client.get(f"/jobs/{job_id}/{path}"), 409, "JOB_FAILED")
    counted = generate_latest(world.app.state.metrics.registry).decode()
    assert 'status="409"' in counted
    assert not re.search(r'regnf_http_requests_total\{[^}]*status="5', counted)


def test_a_dismissed_job_has_no_result(world: World) -> None:
    job_id = world.submit(seed=1)
    world.client.post(f"/jobs/{job_id}/cancel")
    assert_refused(world.client.get(f"/jobs/{job_id}/result"), 409, "JOB_DISMISSED")


@pytest.mark.parametrize(
    ("asked", "start", "stop"),
    [("bytes=0-9", 0, 10), ("bytes=1000-", 1000, 1024), ("bytes=-24", 1000, 1024), ("bytes=1020-9999", 1020, 1024)],
)
def test_one_range_is_honored(world: World, job_id: str, asked: str, start: int, stop: int) -> None:
    answer = world.client.get(f"/jobs/{job_id}/artifacts/scene_points.ply", headers={"Range": asked})
    assert (answer.status_code, answer.content) == (206, DATA[start:stop])
    assert answer.headers["content-range"] == f"bytes {start}-{stop - 1}/1024"
    assert answer.headers["content-length"] == str(stop - start)


@pytest.mark.parametrize(
    "asked",
    ["bytes=0-1,2-3", "bytes=" + ",".join(f"{i}-{i}" for i in range(10_000)), "bytes=5-1", "bytes=-", "items=0-1", "x"],
)
def test_other_ranges_get_the_whole(world: World, job_id: str, asked: str) -> None:
    answer = world.client.get(f"/jobs/{job_id}/artifacts/scene_points.ply", headers={"Range": asked})
    assert (answer.status_code, answer.content) == (200, DATA)


@pytest.mark.parametrize("asked", ["bytes=1024-", "bytes=99999999999-", "bytes=-0"])
def test_a_range_past_the_end_is_refused(world: World, job_id: str, asked: str) -> None:
    answer = world.client.get(f"/jobs/{job_id}/artifacts/scene_points.ply", headers={"Range": asked})
    assert_refused(answer, 416, "RANGE_NOT_SATISFIABLE")
    assert answer.headers["content-range"] == "bytes */1024"


def test_etags_save_bytes_and_guard_ranges(world: World, job_id: str) -> None:
    path = f"/jobs/{job_id}/artifacts/scene_points.ply"
    head = world.client.head(path)
    assert (head.status_code, head.content, head.headers["content-length"]) == (200, b"", "1024")
    etag = head.headers["etag"]
    assert world.client.get(path, headers={"If-None-Match": etag}).status_code == 304
    assert world.client.get(path, headers={"Range": "bytes=0-9", "If-Range": etag}).status_code == 206
    assert world.client.get(path, headers={"Range": "bytes=0-9", "If-Range": '"other"'}).status_code == 200


@pytest.mark.parametrize(
    "name",
    [
        "private.key", "preview.png", "manifest.json", "..%2fmanifest.json", "%2e%2e%2f%2e%2e%2fx", "trace.json%00",
        "trace.json%0d%0aX-Bad:1", "%E2%80%AEnosj.ecart", "x" * 4000, "/etc/passwd", "../manifest.json",
    ],
)  # fmt: skip
def test_only_the_fixed_names_are_artifacts(world: World, job_id: str, name: str) -> None:
    answer = world.client.get(f"/jobs/{job_id}/artifacts/{name}")
    assert answer.status_code == 404
    assert answer.json()["reason"] in ("ARTIFACT_NOT_FOUND", "NOT_FOUND")
    assert "X-Bad" not in answer.headers
    assert world.client.get(f"/jobs/{job_id}/artifacts/trace.json").content == b"[]"
