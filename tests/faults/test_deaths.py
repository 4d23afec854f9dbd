"""Processes that are killed, told to stop or frozen. The first line of each test says what the service makes of it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time

import httpx
import pytest

from regnf_state.queue import Work
from tests.contract.batch_posts import NDJSON
from tests.contract.world import field_bytes, sha256
from tests.faults.house import House
from tests.faults.promise import check_promise, fault, leftovers
from tests.processes import alive, children_of
from tests.worker.bench import eventually


def kill(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()


def test_kill_of_the_job_s_process(house: House) -> None:
    """Its worker notices within a second and has the job run once more."""
    _, worker = house.start_both()
    job_id = house.running()
    with fault():
        os.kill(children_of(worker.pid)[-1], signal.SIGKILL)
        eventually(lambda: house.job(job_id)["attempts"] == 2, house.log)
        house.let_go()
        done = check_promise(house, [job_id])
    assert done[job_id]["attempts"] == 2
    assert worker.poll() is None


def test_kill_of_the_job_s_process_twice(house: House) -> None:
    """The job has failed with WORKER_LOST: what kills its process every time shall not go on for ever."""
    _, worker = house.start_both()
    job_id = house.running()
    with fault():
        os.kill(children_of(worker.pid)[-1], signal.SIGKILL)
        eventually(lambda: (job := house.job(job_id))["attempts"] == 2 and job["phase"] == "optimizing", house.log)
        os.kill(children_of(worker.pid)[-1], signal.SIGKILL)
        check_promise(house, [], {job_id: "WORKER_LOST"})
    house.let_go()
    check_promise(house, [house.submit(1)], {job_id: "WORKER_LOST"})


def test_kill_of_the_worker(house: House) -> None:
    """Its job's heartbeat stops; another worker does the job."""
    _, first = house.start_both()
    job_id = house.running()
    with fault():
        kill(first)
        house.let_go()
        house.start_worker()
        done = check_promise(house, [job_id])
    assert done[job_id]["attempts"] == 2


def test_kill_of_the_worker_once_the_result_stands(house: House) -> None:
    """The next worker finds the result: nothing is run again, nothing is there twice."""
    _, first = house.start_both()
    house.hold("hold-end")
    job_id = house.submit()
    eventually(lambda: f"jobs/{job_id}/manifest.json" in house.store.listing(), house.log)
    with fault():
        kill(first)
        house.let_go("hold-end")
        house.start_worker()
        done = check_promise(house, [job_id])
    assert done[job_id]["attempts"] == 2
    assert f"jobs/{job_id}/1/result.json" in house.store.listing(), "the first attempt's"


def test_sigterm_of_the_worker_during_a_job(house: House) -> None:
    """It lets the job go on for a while, then gives it back to the queue and ends; another worker does the job."""
    _, first = house.start_both()
    job_id = house.running()
    second = house.start_worker()
    with fault():
        first.send_signal(signal.SIGTERM)
        eventually(lambda: house.job(job_id)["attempts"] == 2, house.log)
        assert first.wait(20) == 0
        house.let_go()
        check_promise(house, [job_id])
    assert second.poll() is None


def test_sigstop_of_a_worker_with_its_job(house: House) -> None:
    """Another worker does the job; the frozen one, continued after two minutes, has no say in it, and works on."""
    _, frozen = house.start_both()
    job_id = house.running()
    whole = [frozen.pid, *children_of(frozen.pid)]
    with fault():
        for pid in whole:
            os.kill(pid, signal.SIGSTOP)
        stopped = time.monotonic()
        house.let_go()
        house.start_worker()
        done = house.finished(job_id)
        assert (done["status"], done["attempts"]) == ("successful", 2), house.log()
    time.sleep(max(0.0, stopped + house.pace.lasting(0.0, 120.0) - time.monotonic()))
    for pid in reversed(whole):
        os.kill(pid, signal.SIGCONT)
    eventually(lambda: not children_of(frozen.pid), house.log)
    assert check_promise(house, [job_id])[job_id] == done
    others = [house.submit(seed) for seed in range(1, 5)]
    check_promise(house, [job_id, *others])
    assert frozen.poll() is None


def test_kill_of_the_api_during_a_job(house: House) -> None:
    """Workers go on; whoever asks the next API process is told how the job ended."""
    first, _ = house.start_both()
    job_id = house.running()
    with fault():
        kill(first)
        house.let_go()
        house.start_api()
        done = check_promise(house, [job_id])
    assert done[job_id]["attempts"] == 1


def test_sigterm_of_the_api_during_a_job(house: House) -> None:
    """Its event streams end in order, workers go on, and the next API process tells how the job ended."""
    first, _ = house.start_both()
    job_id = house.running()
    with house.client.stream("GET", f"/jobs/{job_id}/events") as events, fault():
        lines = events.iter_lines()
        assert next(lines).startswith(("id:", "event:", "retry:"))
        first.send_signal(signal.SIGTERM)
        assert all("successful" not in line for line in lines), "read to its end, which is no broken connection"
        assert first.wait(20) in (0, -signal.SIGTERM), "uvicorn ends by the signal once all is in order"
        house.let_go()
        house.start_api()
        check_promise(house, [job_id])


@pytest.mark.long
def test_kill_of_the_api_during_an_upload(folder_house: House) -> None:
    """What had come of the upload goes when the next API process starts; the upload may be sent again."""
    house = folder_house
    first, _ = house.start_both()
    data = field_bytes("scene", 8 << 20)

    def half() -> object:
        yield data[: 5 << 20]
        eventually(lambda: any((house.state("api") / "blobs" / ".tmp").iterdir()), house.log)
        kill(first)
        yield data[5 << 20 :]

    with fault():
        with pytest.raises(httpx.TransportError):
            house.client.put(f"/fields/{sha256(data)}", content=half())
        assert leftovers(house), "nobody has cleared up yet"
        house.start_api()
        eventually(lambda: not leftovers(house), lambda: str(leftovers(house)))
        house.upload(data)
        eventually(lambda: house.field(sha256(data))["state"] == "ready", house.log)
    check_promise(house, [house.submit()])


@pytest.mark.long
def test_kill_of_the_api_between_a_job_s_record_and_its_queue(house: House) -> None:
    """The reaper of the next API process queues what no queue holds."""
    first, _ = house.start_both()
    request = house.request()
    job_id = house.client.post("/register", json=request, params={"dry_run": True}).json()["id"]
    kill(first)
    dying = house.start_api(REGNF_TEST_DIE="1")
    with fault():
        with pytest.raises(httpx.TransportError):
            house.client.post("/register", json=request)
        assert dying.wait(20) == -signal.SIGKILL
        house.start_api()
        check_promise(house, [job_id])


@pytest.mark.long
def test_kill_of_the_api_in_the_middle_of_a_batch(folder_house: House) -> None:
    """The lines, posted again, are one batch with a job each; once it is accepted, Redis and the API may go."""
    house = folder_house
    first = house.start_api()
    request = house.request()
    lines = "\n".join(json.dumps(request | {"seed": seed}) for seed in range(250))
    kill(first)
    dying = house.start_api(REGNF_TEST_DIE="2")
    with fault():
        with pytest.raises(httpx.TransportError):
            house.client.post("/batches", content=lines, headers=NDJSON)
        assert dying.wait(20) == -signal.SIGKILL
        accepted = [key for key in house.store.listing() if key.endswith("-accepted")]
        assert 0 < len(accepted) < 250, "the middle"
        second = house.start_api()
        answer = house.client.post("/batches", content=lines, headers=NDJSON)
        house.redis.flushall()
        kill(second)
        assert answer.status_code == 202
        house.start_api()
        path = f"/batches/{answer.json()['id']}"
        eventually(lambda: house.client.get(path).json().get("active") == 250, house.log)
        jobs = house.client.get("/jobs?limit=200").json()["jobs"]
    assert {job["attempts"] for job in jobs} <= {1, 2}
    names = [key.split("/")[2] for key in house.store.listing() if key.startswith("journal/jobs/")]
    assert len(names) == len(set(names)) == 250, "no job twice"


def test_two_workers_with_one_job(house: House) -> None:
    """The queue hands it out twice; one worker claims it, the other lets go of it."""
    workers = [house.start_both()[1], house.start_worker()]
    job_id = house.running()
    with fault():
        house.redis.rpush("rq:queue:regnf", Work("registration", job_id, 1).name)
        eventually(lambda: "is not run" in house.log(), house.log)
        house.let_go()
        done = check_promise(house, [job_id])
    assert done[job_id]["attempts"] == 1
    assert [worker.poll() for worker in workers] == [None, None]


def test_kill_of_the_worker_during_an_import(house: House) -> None:
    """The import is held for a minute after its worker's last word; then another worker does it."""
    if not house.pace.whole:
        pytest.skip(
            "RQ holds what a dead worker had for a minute, which no setting shortens: python -m benchmarks.faults"
        )
    _, first = house.start_both()
    house.hold("hold-import")
    name = house.upload(field_bytes("scene"))
    eventually(lambda: children_of(first.pid), house.log)
    with fault():
        kill(first)
        house.let_go("hold-import")
        house.start_worker()
        eventually(lambda: house.field(name)["state"] == "ready", house.log, 130.0)
    check_promise(house, [house.submit()])
    assert not alive(first.pid)
