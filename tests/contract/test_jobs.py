"""Jobs over HTTP: documents, waiting, events, cancelling, deleting."""

from __future__ import annotations

import json
import threading
from typing import Any

from tests.contract.world import NOBODY, World, assert_refused
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
