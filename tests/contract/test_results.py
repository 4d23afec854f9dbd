"""Results and artifacts over HTTP."""

from __future__ import annotations

import re

import httpx
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


def test_there_is_no_result_before_the_end_nor_of_a_dismissed_job(world: World) -> None:
    job_id = world.submit(seed=1)
    for path in ("result", "artifacts/trace.json"):
        answer = world.client.get(f"/jobs/{job_id}/{path}")
        assert_refused(answer, 409, "JOB_NOT_READY")
        assert answer.headers["retry-after"] == "1"
    world.client.post(f"/jobs/{job_id}/cancel")
    assert_refused(world.client.get(f"/jobs/{job_id}/result"), 409, "JOB_DISMISSED")


def test_a_failed_job_answers_with_its_own_problem(world: World) -> None:
    """Whatever its reason, known or not: polling it is no error of the server."""
    detail = "12 surface points were found; 500 are needed."
    reasons = ("NO_SURFACE_IN_DETECTION", "SOMETHING_NEW", "WORKER_LOST", "JOB_TIMEOUT", "STORAGE_FULL", "INTERNAL")
    for seed, reason in enumerate(reasons):
        job_id = world.submit(seed=seed)
        status = REASONS[reason].status if reason in REASONS else 422
        world.fail(job_id, reason=reason, title="Failed", status=status, detail=detail, found=12)
        for path in ("result", "artifacts/trace.json"):
            problem = assert_refused(world.client.get(f"/jobs/{job_id}/{path}"), 409, "JOB_FAILED")
            assert problem["detail"] == f"{reason}: {detail}"
        own = problem["error"]
        assert (own["reason"], own["status"], own["detail"], own["found"]) == (reason, status, detail, 12)
        assert world.client.get(f"/jobs/{job_id}").json()["error"] == own
    counted = generate_latest(world.app.state.metrics.registry).decode()
    assert 'status="409"' in counted
    assert not re.search(r'regnf_http_requests_total\{[^}]*status="5', counted)


def test_ranges(world: World, job_id: str) -> None:
    """One is honored, what is none gets the whole, one past the end is refused."""

    def ranged(asked: str) -> httpx.Response:
        return world.client.get(f"/jobs/{job_id}/artifacts/scene_points.ply", headers={"Range": asked})

    one = {
        "bytes=0-9": (0, 10),
        "bytes=1000-": (1000, 1024),
        "bytes=-24": (1000, 1024),
        "bytes=1020-9999": (1020, 1024),
    }
    for asked, (start, stop) in one.items():
        answer = ranged(asked)
        assert (answer.status_code, answer.content) == (206, DATA[start:stop])
        assert answer.headers["content-range"] == f"bytes {start}-{stop - 1}/1024"
        assert answer.headers["content-length"] == str(stop - start)
    many = "bytes=" + ",".join(f"{i}-{i}" for i in range(10_000))
    for asked in (many, "bytes=0-1,2-3", "bytes=5-1", "bytes=-", "items=0-1", "x"):
        assert (ranged(asked).status_code, ranged(asked).content) == (200, DATA), asked
    for asked in ("bytes=1024-", "bytes=99999999999-", "bytes=-0"):
        refused = ranged(asked)
        assert_refused(refused, 416, "RANGE_NOT_SATISFIABLE")
        assert refused.headers["content-range"] == "bytes */1024"


def test_etags_guard_ranges(world: World, job_id: str) -> None:
    path = f"/jobs/{job_id}/artifacts/scene_points.ply"
    head = world.client.head(path)
    assert (head.status_code, head.content, head.headers["content-length"]) == (200, b"", "1024")
    etag = head.headers["etag"]
    assert world.client.get(path, headers={"Range": "bytes=0-9", "If-Range": etag}).status_code == 206
    assert world.client.get(path, headers={"Range": "bytes=0-9", "If-Range": '"other"'}).status_code == 200


ODD_NAMES = (
    "private.key", "preview.png", "manifest.json", "..%2fmanifest.json", "%2e%2e%2f%2e%2e%2fx", "trace.json%00",
    "trace.json%0d%0aX-Bad:1", "%E2%80%AEnosj.ecart", "x" * 4000, "/etc/passwd", "../manifest.json",
)  # fmt: skip


def test_only_the_fixed_names_are_artifacts(world: World, job_id: str) -> None:
    for name in ODD_NAMES:
        answer = world.client.get(f"/jobs/{job_id}/artifacts/{name}")
        assert answer.status_code == 404, name
        assert answer.json()["reason"] in ("ARTIFACT_NOT_FOUND", "NOT_FOUND")
        assert "X-Bad" not in answer.headers
    assert world.client.get(f"/jobs/{job_id}/artifacts/trace.json").content == b"[]"
