"""What is lost, killed or away, and what the service promises all the same."""

from __future__ import annotations

import json
import os
import signal
from typing import Any

import httpx
import pytest

from tests.faults.conftest import House
from tests.worker.bench import children_of, eventually


def result(house: House, job_id: str) -> dict[str, Any]:
    answer = house.client.get(f"/jobs/{job_id}/artifacts/result.json")
    assert answer.status_code == 200, answer.text
    document: dict[str, Any] = json.loads(answer.content)
    return document


def test_redis_is_emptied_while_jobs_wait_and_run(house: House) -> None:
    house.start_api()
    house.start_worker()
    house.hold_jobs()
    jobs = [house.submit(seed) for seed in range(3)]
    house.reaches(jobs[0], "running")
    assert [house.job(job_id)["status"] for job_id in jobs[1:]] == ["accepted", "accepted"]
    house.redis.flushall()
    for job_id in jobs:
        house.job(job_id)  # never 404, not for a moment
    house.reaches(jobs[0], "running")
    house.let_jobs_go()
    for job_id in jobs:
        assert house.finished(job_id)["status"] == "successful", house.log()
        assert result(house, job_id)["pid"]
    assert house.job(jobs[0])["attempts"] > 1
    house.redis.flushall()
    assert {house.job(job_id)["status"] for job_id in jobs} == {"successful"}
    for name, count in (("jobs", 3), ("fields", 2)):
        eventually(lambda name=name, count=count: len(house.client.get(f"/{name}").json()[name]) == count, house.log)


def test_the_api_is_killed_between_a_job_s_record_and_its_queue(house: House) -> None:
    house.start_api()
    house.start_worker()
    request = house.request()
    job_id = house.client.post("/register", json=request, params={"dry_run": True}).json()["id"]
    house.processes[0].kill()
    house.processes[0].wait()
    dying = house.start_api(REGNF_TEST_DIE="1")
    with pytest.raises(httpx.TransportError):
        house.client.post("/register", json=request)
    assert dying.wait(20) == -9
    house.start_api()
    assert house.finished(job_id)["status"] == "successful", house.log()


def test_a_job_s_process_is_killed_and_its_worker_goes_on(house: House) -> None:
    """What the worker itself has to ask the object store must not harm the processes that it forks later."""
    house.start_api()
    worker = house.start_worker()
    house.hold_jobs()
    job_id = house.submit()
    house.reaches(job_id, "running")
    (child,) = children_of(worker.pid)
    os.kill(child, signal.SIGKILL)
    failed = house.finished(job_id)
    assert (failed["status"], failed["error"]["reason"]) == ("failed", "WORKER_LOST")
    house.let_jobs_go()
    assert house.finished(house.submit())["status"] == "successful", house.log()
    assert worker.poll() is None


def test_a_worker_is_killed_and_another_does_its_job(house: House) -> None:
    house.start_api(REGNF_LOST_AFTER_S="1")
    first = house.start_worker()
    house.hold_jobs()
    job_id = house.submit()
    house.reaches(job_id, "running")
    first.kill()
    first.wait()
    house.let_jobs_go()
    house.start("worker")
    done = house.finished(job_id)
    assert (done["status"], done["attempts"]) == ("successful", 2), house.log()


def test_the_storage_is_away_for_some_seconds(house: House) -> None:
    house.start_api()
    house.start_worker()
    house.hold_jobs()
    request = house.request(seed=9)
    job_id = house.submit()
    house.reaches(job_id, "running")
    house.objects.freeze()
    house.let_jobs_go()
    refused = house.client.post("/register", json=request)
    assert (refused.status_code, refused.json()["reason"]) == (503, "STORAGE_UNAVAILABLE"), refused.text
    assert house.client.get("/readyz").json()["checks"]["storage"] is False
    assert house.job(job_id)["status"] == "running"
    house.objects.thaw()
    done = house.finished(job_id)
    assert (done["status"], done["attempts"]) == ("successful", 1), house.log()
    again = house.client.post("/register", json=request)
    assert again.status_code in (200, 202), again.text
    assert house.finished(again.json()["id"])["status"] == "successful"
