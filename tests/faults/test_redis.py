"""Redis restarted, emptied, full, away, slow. The first line of each test says what the service makes of it."""

from __future__ import annotations

import signal
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from regnf_state.settings import variables
from tests.faults.house import DEADLINE_S, House
from tests.faults.promise import check_promise, fault
from tests.faults.proxy import Proxy
from tests.worker.bench import eventually


def restart(house: House, away_s: float = 0.0) -> None:
    house.server.kill()
    time.sleep(away_s)
    house.server.start()


def test_redis_restarted_while_idle(house: House) -> None:
    """Nobody notices."""
    _, worker = house.start_both()
    before = house.submit()
    check_promise(house, [before])
    with fault():
        restart(house)
        check_promise(house, [before, house.submit(1)])
    assert worker.poll() is None


def test_redis_restarted_during_a_job(house: House) -> None:
    """The job goes on; calls that come meanwhile wait for a few seconds."""
    _, worker = house.start_both()
    job_id = house.running()
    waiting = house.submit(1)
    with fault():
        restart(house)
        assert house.job(job_id)["status"] == "running"
        house.let_go()
        done = check_promise(house, [job_id, waiting])
    assert [job["attempts"] for job in done.values()] == [1, 1]
    assert worker.poll() is None


def test_redis_restarted_between_a_result_and_its_word(house: House) -> None:
    """The result stands, its word waits for Redis; nothing is run again."""
    house.start_both()
    house.hold("hold-end")
    job_id = house.submit()
    eventually(lambda: f"jobs/{job_id}/manifest.json" in house.store.listing(), house.log)
    with fault() as one:
        house.server.kill()
        house.let_go("hold-end")
        time.sleep(house.pace.lasting(0.5, 10.0))
        house.server.start()
        one.over()
        done = check_promise(house, [job_id])
    assert done[job_id]["attempts"] == 1


def test_redis_away_for_longer_than_heartbeats_may_be_silent(house: House) -> None:
    """Running jobs wait with what they have; heartbeats get time to come again before anybody is taken for lost."""
    if not house.pace.whole:
        pytest.skip("how long clients wait before they connect again cannot be shortened: python -m benchmarks.faults")
    _, worker = house.start_both()
    job_id = house.running()
    with fault() as one:
        house.server.kill()
        time.sleep(120.0)
        house.server.start()
        one.over()
        waiting = house.submit(1)
    time.sleep(35.0)  # two rounds of the reaper
    house.let_go()
    done = check_promise(house, [job_id, waiting])
    assert [job["attempts"] for job in done.values()] == [1, 1]
    assert worker.poll() is None


def test_redis_emptied(house: House) -> None:
    """Records are made anew from the journal, never 404; what ran is run once more, as an attempt of its own."""
    house.start_both()
    first = house.running()
    jobs = [first, *(house.submit(seed) for seed in (1, 2))]
    with fault():
        house.redis.flushall()
        assert {house.job(job_id)["status"] for job_id in jobs} <= {"accepted", "running"}
        # whichever is queued first again: their order is that of their ids
        eventually(lambda: "running" in {house.job(job_id)["status"] for job_id in jobs}, house.log, DEADLINE_S)
        house.let_go()
        done = check_promise(house, jobs)
    assert done[first]["attempts"] > 1
    house.redis.flushall()
    assert {house.job(job_id)["status"] for job_id in jobs} == {"successful"}
    for name, count in (("jobs", 3), ("fields", 2)):
        eventually(lambda name=name, count=count: len(house.client.get(f"/{name}").json()[name]) == count, house.log)


@pytest.mark.long
def test_redis_out_of_memory(house: House) -> None:
    """New requests are told 507; what runs waits with its result until Redis takes it."""
    _, worker = house.start_both()
    job_id = house.running()
    request = house.request(seed=1)
    with fault() as one:
        house.redis.config_set("maxmemory", 1)
        refused = house.client.post("/register", json=request)
        assert (refused.status_code, refused.json()["reason"]) == (507, "STORAGE_FULL")
        assert "Retry-After" in refused.headers
        house.let_go()
        time.sleep(house.pace.lasting(2.6, 120.0))
        house.redis.config_set("maxmemory", 0)
        one.over()
        done = check_promise(house, [job_id])
        again = house.client.post("/register", json=request)
        assert again.status_code == 202, again.text
        check_promise(house, [job_id, again.json()["id"]])
    assert done[job_id]["attempts"] == 1
    assert worker.poll() is None


@pytest.mark.long
def test_redis_frozen(house: House) -> None:
    """Calls are told 503 within four seconds, then at once; pages come, streams end; then everything goes on."""
    _, worker = house.start_both()
    job_id = house.running()
    assert house.server.process is not None
    with fault() as one, house.client.stream("GET", f"/jobs/{job_id}/events", timeout=20) as stream:
        lines = stream.iter_lines()
        next(lines)
        house.server.process.send_signal(signal.SIGSTOP)
        with ThreadPoolExecutor(60) as pool:
            asked = [pool.submit(house.client.get, f"/jobs/{job_id}", timeout=20) for _ in range(60)]
            assert house.client.get("/static/favicon.svg", timeout=20).status_code == 200
            assert house.client.get("/healthz", timeout=20).status_code == 200
            answers = [each.result() for each in asked]
        assert {(each.status_code, each.json()["reason"]) for each in answers} == {(503, "STORAGE_UNAVAILABLE")}
        assert all("Retry-After" in each.headers for each in answers)
        list(lines)  # the stream ends, and whole: a broken one raises
        house.server.process.send_signal(signal.SIGCONT)
        eventually(lambda: house.client.get(f"/jobs/{job_id}").status_code == 200, house.log)
        one.over()
        house.let_go()
        done = check_promise(house, [job_id])
    assert done[job_id]["attempts"] == 1
    assert worker.poll() is None


@pytest.mark.long
def test_redis_100_ms_away(far_house: House, network: Proxy) -> None:
    """Each of eight jobs takes some six seconds longer, and nothing else changes."""
    house = far_house
    house.environment |= variables(heartbeat_s=1, lost_after_s=2.4)
    house.start_both()
    before = house.submit()
    check_promise(house, [before])
    with fault():
        network.delay_s = 0.1
        done = check_promise(house, [before, *(house.submit(seed) for seed in range(1, 9 if house.pace.whole else 2))])
    assert {job["attempts"] for job in done.values()} == {1}


@pytest.mark.long
def test_connections_to_redis_reset(far_house: House, network: Proxy) -> None:
    """Commands are repeated, which changes nothing that was done already; what fell out of a queue is queued again."""
    house = far_house
    _, worker = house.start_both()
    jobs: list[str] = []
    with fault() as one:
        end = time.monotonic() + house.pace.lasting(3.0, 30.0)
        while time.monotonic() < end or len(jobs) < 3:
            answer = house.client.post("/register", json=house.request(len(jobs)))
            if answer.status_code != 503:
                jobs.append(answer.json()["id"])
            assert network.reset()
            time.sleep(0.3)
        one.over()
        check_promise(house, jobs)
    assert worker.poll() is None
