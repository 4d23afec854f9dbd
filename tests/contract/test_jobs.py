"""Jobs over HTTP: documents, waiting, events, cancelling, deleting."""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Callable
from itertools import product
from typing import Any, BinaryIO

import httpx
import pytest
from prometheus_client import generate_latest

from regnf_state.reasons import REASONS
from regnf_state.records import FieldRecord
from tests.contract.world import NOBODY, RESULT, World, assert_refused, field_bytes
from tests.stores import expire


def test_the_document_follows_the_record(world: World) -> None:
    job_id = world.submit()
    waiting = world.client.get(f"/jobs/{job_id}")
    assert (waiting.json()["status"], waiting.json()["queue_position"]) == ("accepted", 1)
    assert waiting.headers["retry-after"] == "1"
    assert "cancel" in waiting.json()["links"]
    world.run(job_id)
    engine = {"version": "0.1.0", "device": "cpu"}
    world.records.update_job(job_id, 1, phase="optimizing", progress=0.5, engine=engine)
    running = world.client.get(f"/jobs/{job_id}").json()
    expected = {"status": "running", "phase": "optimizing", "progress": 0.5, "queue_position": None, "engine": engine}
    assert {name: running[name] for name in expected} == expected
    assert running["started_at"].endswith("Z")
    world.succeed(job_id)
    answer = world.client.get(f"/jobs/{job_id}")
    assert "retry-after" not in answer.headers
    assert answer.json()["expires_at"] > answer.json()["finished_at"]
    assert answer.json()["links"]["result"] == f"/jobs/{job_id}/result"
    assert [answer.json()[told] for told in ("verdict", "probability", "level")] == ["registered", 0.95, "default"]


def test_waiting_ends_with_the_job(world: World) -> None:
    job_id = world.submit()
    worker = threading.Timer(0.1, world.succeed, (job_id,))
    worker.start()
    answer = world.client.get(f"/jobs/{job_id}", params={"wait": 20})
    worker.join()
    assert answer.json()["status"] == "successful"


def test_lists_go_page_by_page_and_by_status(world: World) -> None:
    ids = [world.submit(seed=seed) for seed in range(3)]
    world.succeed(ids[1])
    first = world.client.get("/jobs", params={"limit": 2}).json()
    second = world.client.get("/jobs", params={"limit": 2, "page_token": first["next_page_token"]}).json()
    assert [job["id"] for job in first["jobs"] + second["jobs"]] == ids[::-1]
    assert second["next_page_token"] is None
    chosen = world.client.get("/jobs", params={"status": "successful"}).json()
    assert [job["id"] for job in chosen["jobs"]] == [ids[1]]


def events_of(text: str) -> list[dict[str, Any]]:
    """The events of a stream's text, comments and retry lines left out."""
    events = []
    for block in text.split("\n\n"):
        lines = dict(line.split(": ", 1) for line in block.splitlines() if not line.startswith(":"))
        if "data" in lines:
            events.append({"id": lines["id"], "event": lines["event"], "data": json.loads(lines["data"])})
    return events


def test_the_event_stream_tells_everything_and_ends_with_the_job(world: World) -> None:
    job_id = world.submit()
    worker = threading.Timer(0.1, world.succeed, (job_id,))
    worker.start()
    answer = world.client.get(f"/jobs/{job_id}/events")
    worker.join()
    assert answer.headers["content-type"].startswith("text/event-stream")
    events = events_of(answer.text)
    states = [event["data"]["status"] for event in events if event["event"] == "status"]
    assert states == ["accepted", "running", "successful"]
    rest = world.client.get(f"/jobs/{job_id}/events", headers={"Last-Event-ID": events[0]["id"]})
    assert events_of(rest.text) == events[1:]
    done = world.client.get(f"/jobs/{job_id}/events", headers={"Last-Event-ID": events[-1]["id"]})
    assert done.status_code == 204


def test_the_stream_of_a_failed_job_carries_the_problem(world: World) -> None:
    job_id = world.submit()
    world.fail(job_id, reason="NO_INITIAL_TRANSFORM", status=422, title="No", detail="none")
    last = events_of(world.client.get(f"/jobs/{job_id}/events").text)[-1]
    assert (last["data"]["status"], last["data"]["error"]["reason"]) == ("failed", "NO_INITIAL_TRANSFORM")


def test_cancelling_dismisses_a_waiting_job_once_asks_a_running_ones_worker_and_refuses_a_finished_one(
    world: World,
) -> None:
    def cancelled(job_id: str) -> tuple[int, str, bool]:
        answer = world.client.post(f"/jobs/{job_id}/cancel")
        return answer.status_code, answer.json()["status"], answer.json()["cancel_requested"]

    waiting, running, finished = (world.submit(seed=seed) for seed in range(3))
    assert cancelled(waiting)[:2] == (202, "dismissed")
    assert cancelled(waiting)[:2] == (200, "dismissed")
    world.run(running)
    assert cancelled(running) == (202, "running", True)
    assert world.queue.stopped == [(waiting, 1), (running, 1)]
    world.succeed(finished)
    assert_refused(world.client.post(f"/jobs/{finished}/cancel"), 409, "JOB_FINISHED")


def test_deleting_takes_the_artifacts_along(world: World) -> None:
    job_id = world.submit()
    assert_refused(world.client.delete(f"/jobs/{job_id}"), 409, "JOB_ACTIVE")
    world.succeed(job_id, {"trace.json": b"[]"})
    assert world.client.delete(f"/jobs/{job_id}").status_code == 204
    assert world.blobs.blobs == {}
    for path in ("", "/result", "/request", "/events", "/view", "/artifacts/trace.json"):
        assert_refused(world.client.get(f"/jobs/{job_id}{path}"), 404, "JOB_NOT_FOUND")


def test_a_job_that_outlived_its_retention_is_gone(world: World) -> None:
    job_id = world.submit()
    world.succeed(job_id)
    expire(world.redis, job_id)
    for path in ("", "/result", "/request", "/events", "/view"):
        assert_refused(world.client.get(f"/jobs/{job_id}{path}"), 410, "JOB_EXPIRED")
    world.records.expire_jobs()
    assert_refused(world.client.get(f"/jobs/{job_id}"), 410, "JOB_EXPIRED")


def test_nobody_is_found_under_no_id(world: World) -> None:
    for odd in (NOBODY, "x" * 300, "..%2F..%2Fetc", "%00", "a.b", "%E2%80%AE"):
        answer = world.client.get(f"/jobs/{odd}")
        assert answer.status_code == 404
        assert answer.json()["reason"] in ("JOB_NOT_FOUND", "NOT_FOUND")


# results and artifacts over HTTP


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


@pytest.fixture
def drawings(monkeypatch: pytest.MonkeyPatch) -> list[bytes]:
    """What was drawn, in place of pictures: what the clouds hold."""
    drawn: list[bytes] = []

    def picture(open_file: Callable[[str], BinaryIO]) -> bytes:
        with open_file("aligned.ply") as file:
            drawn.append(file.read())
        return drawn[-1]

    monkeypatch.setattr("regnf_core.viewing.registration_picture.stored_picture", picture)
    return drawn


def states(world: World, job_id: str) -> dict[str, str]:
    document = world.client.get(f"/jobs/{job_id}/result").json()
    return {entry["name"]: entry["state"] for entry in document["artifacts"]}


def test_a_picture_is_drawn_when_it_is_first_asked_for(world: World, drawings: list[bytes]) -> None:
    job_id = world.submit(seed=1)
    world.succeed(job_id, pending=["aligned.ply"], on_request=["preview.png"])
    address = f"/jobs/{job_id}/artifacts/preview.png"
    assert states(world, job_id)["preview.png"] == "pending"
    assert_refused(world.client.get(address, params={"wait": 0}), 409, "ARTIFACT_NOT_READY")
    world.finish(job_id, {"aligned.ply": DATA})
    listed = {one["name"]: one for one in world.client.get(f"/jobs/{job_id}/result").json()["artifacts"]}
    assert (listed["preview.png"]["state"], listed["preview.png"]["bytes"], drawings) == ("ready", None, [])
    assert world.client.head(address).headers["content-length"] == str(len(DATA))
    assert world.client.get(f"/jobs/{job_id}/result").json()["artifacts"][-1]["bytes"] == len(DATA)
    assert world.client.get(address).content == DATA
    assert drawings == [DATA]


@pytest.mark.parametrize("clouds", [True, False])
def test_a_picture_that_cannot_be_drawn_is_missing(world: World, drawings: list[bytes], clouds: bool) -> None:
    """Since the clouds have come and do not read, or since they do not come."""
    job_id = world.submit(seed=1)
    world.succeed(job_id, pending=["aligned.ply"], on_request=["preview.png"])
    if clouds:
        world.finish(job_id, {"scene_points.ply": DATA})
    else:
        world.records.ahead_s = world.settings.lost_after_s + 1
    assert_refused(world.client.get(f"/jobs/{job_id}/artifacts/preview.png"), 404, "ARTIFACT_NOT_FOUND")
    missing = world.client.get(f"/jobs/{job_id}/result").json()["missing_artifacts"]
    assert missing == (["preview.png"] if clouds else ["aligned.ply", "preview.png"])
    assert drawings == []


def test_a_job_deleted_while_its_picture_is_drawn_leaves_nothing(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    job_id = world.submit(seed=1)
    world.succeed(job_id, on_request=["preview.png"])

    def picture(_: object) -> bytes:
        world.records.delete_job(job_id)
        world.blobs.delete_prefix(f"jobs/{job_id}")
        return b"a picture"

    monkeypatch.setattr("regnf_core.viewing.registration_picture.stored_picture", picture)
    assert_refused(world.client.get(f"/jobs/{job_id}/artifacts/preview.png"), 410, "JOB_EXPIRED")
    assert [key for key in world.blobs.blobs if key.startswith("jobs/")] == []


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
    def ranged(asked: str) -> httpx.Response:
        return world.client.get(f"/jobs/{job_id}/artifacts/scene_points.ply", headers={"Range": asked})

    one = {
        "bytes=0-9": (0, 10), "bytes=0-0": (0, 1), "bytes=1000-": (1000, 1024), "bytes=1020-9999": (1020, 1024),
        "bytes=-24": (1000, 1024), "bytes=-3000": (0, 1024),
    }  # fmt: skip
    for asked, (start, stop) in one.items():
        answer = ranged(asked)
        assert (answer.status_code, answer.content) == (206, DATA[start:stop])
        assert answer.headers["content-range"] == f"bytes {start}-{stop - 1}/1024"
        assert answer.headers["content-length"] == str(stop - start)
    many, digits = "bytes=" + ",".join(f"{i}-{i}" for i in range(10_000)), "bytes=" + "9" * 40 + "-"
    for asked in (many, digits, "bytes=0-1,2-3", "bytes=5-1", "bytes=", "bytes=-", "items=0-1", "x"):
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


def addresses(world: World) -> list[str]:
    job, known, asked = world.submit(), world.ready_field("a"), "a" * 64
    world.succeed(job, {"trace.json": b"[]"})
    now = world.records.now()
    error = {"reason": "LAYOUT_AMBIGUOUS", "candidates": [{"picture": True}]}
    world.records.create_field(FieldRecord(asked, "rejected", 1, now, now, error=error, original_until=now + 60.0))
    places = [f"/fields/{known}/preview.png", f"/fields/{asked}/candidates/1.png"]
    for place in places:
        world.blobs.put(place[1:], b"a picture")
    return [*places, f"/jobs/{job}", f"/fields/{known}", f"/jobs/{job}/artifacts/trace.json"]


def test_every_etag_is_honored(world: World) -> None:
    """As RFC 9110 defines it: weak comparison, lists, `*`. A malformed header sets no condition."""
    for path, method in product(addresses(world), ("GET", "HEAD")):
        whole = world.client.request(method, path)
        if whole.status_code == 405:  # a job's document
            continue
        etag = whole.headers["etag"]
        held = (etag, f"W/{etag}", f'"x", {etag}', f'W/"x" ,,W/{etag} ', "*", " * ", f'"a,b", {etag}')
        others = ('"x"', f'W/"x", "{etag[1:-2]}"', f'"x,{etag[1:]}', '""')
        malformed = ("", etag[1:-1], f"{etag} {etag}", f"w/{etag}", f"{etag}, *", etag[:-1], f'{etag[:-1]} "')
        for header in held + others + malformed:
            answer = world.client.request(method, path, headers={"If-None-Match": header})
            assert answer.status_code == (304 if header in held else 200), (path, header)
            assert (answer.content == b"") == (header in held or method == "HEAD")
            assert [answer.headers[one] == whole.headers[one] for one in ("etag", "cache-control")] == [True, True]


def test_an_etag_holds_until_something_changes_and_a_heartbeat_is_no_change(world: World) -> None:
    job_id = world.submit()
    path = f"/jobs/{job_id}"
    etag = world.client.get(path).headers["etag"]
    assert world.client.get(path, headers={"If-None-Match": etag}).status_code == 304
    world.run(job_id)
    changed = world.client.get(path, headers={"If-None-Match": etag})
    assert changed.status_code == 200
    world.records.heartbeat(job_id, 1)
    assert world.client.get(path, headers={"If-None-Match": changed.headers["etag"]}).status_code == 304


@pytest.mark.parametrize("weak", ["", "W/"])
def test_waiting_with_an_etag_ends_at_the_first_change(world: World, weak: str) -> None:
    job_id, data = world.submit(), field_bytes("new")
    sent = world.client.post("/fields", content=data)
    etag = world.client.get(f"/jobs/{job_id}").headers["etag"]
    changes = [
        (f"/jobs/{job_id}", etag, threading.Timer(0.1, world.run, (job_id,)), "status", "running"),
        (sent.headers["location"], sent.headers["etag"],
         threading.Timer(0.1, world.records.update_field, (sent.json()["sha256"],), {"label": "a room"}), "label",
         "a room"),
    ]  # fmt: skip
    for path, held, change, member, value in changes:
        change.start()
        answer = world.client.get(path, params={"wait": 20}, headers={"If-None-Match": weak + held})
        change.join()
        assert (answer.status_code, answer.json()[member]) == (200, value)
