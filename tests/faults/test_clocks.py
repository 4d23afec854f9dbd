"""Wall clocks that are stepped by an hour. The first line of each test says what the service makes of it."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from email.utils import parsedate_to_datetime
from pathlib import Path

import pytest

from tests.contract.world import field_bytes
from tests.faults.clock import SteppedClock, stepped_clock
from tests.faults.conftest import house_over
from tests.faults.house import House
from tests.faults.promise import check_promise, fault
from tests.faults.stores import Folder
from tests.restartable_redis import restartable_redis
from tests.worker.bench import eventually

HOUR_S = 3600
STEPS = pytest.mark.parametrize("step", [HOUR_S, -HOUR_S], ids=["forwards", "backwards"])


@pytest.fixture
def clocks(tmp_path: Path) -> dict[str, SteppedClock]:
    return {name: stepped_clock(tmp_path, name) for name in ("redis", "api", "worker")}


@pytest.fixture
def house(tmp_path: Path, clocks: dict[str, SteppedClock]) -> Iterator[House]:
    """A house whose processes each have a clock of their own."""
    with (
        restartable_redis(environment=os.environ | clocks["redis"].environment) as server,
        house_over(tmp_path, server, Folder(tmp_path / "state")) as made,
    ):
        yield made


def is_off_by(house: House, clock: str, step: int) -> bool:
    """Whether a process tells the time as it was stepped: otherwise the test would show nothing."""
    if clock == "redis":
        seen = house.redis.time()[0]
    elif clock == "api":
        seen = parsedate_to_datetime(house.client.get("/healthz").headers["Date"]).timestamp()
    else:
        (key,) = house.redis.keys("rq:worker:*")
        seen = parsedate_to_datetime_of(house.redis.hget(key, "last_heartbeat"))
    return abs(seen - time.time() - step) < HOUR_S / 2


def parsedate_to_datetime_of(text: bytes) -> float:
    from rq.utils import utcparse

    return float(utcparse(text.decode()).timestamp())


@STEPS
@pytest.mark.parametrize("clock", ["redis", "api", "worker"])
def test_a_clock_stepped_during_a_job(house: House, clocks: dict[str, SteppedClock], clock: str, step: int) -> None:
    """Nothing happens: leases and heartbeats are Redis' own, and nobody is lost whose heartbeat is seen to change."""
    house.start_api(**clocks["api"].environment)
    worker = house.start_worker(**clocks["worker"].environment)
    job_id = house.running()
    waiting = house.submit(1)
    with fault():
        clocks[clock].step(step)
        eventually(lambda: is_off_by(house, clock, step), clock)
        time.sleep(house.pace.lasting(1.2, 35.0))  # two rounds of the reaper
        house.let_go()
        done = check_promise(house, [job_id, waiting])
    assert [job["attempts"] for job in done.values()] == [1, 1]
    assert worker.poll() is None


@pytest.mark.parametrize("clock", ["redis", "api", "worker"])
def test_a_clock_stepped_during_an_import(house: House, clocks: dict[str, SteppedClock], clock: str) -> None:
    """The import goes on, and is done once."""
    house.start_api(**clocks["api"].environment)
    house.start_worker(**clocks["worker"].environment)
    house.hold("hold-import")
    name = house.upload(field_bytes("scene"))
    eventually(lambda: "work-horse" in house.log() or house.redis.keys("regnf:remembered:import:*"), house.log)
    with fault():
        clocks[clock].step(HOUR_S)
        time.sleep(house.pace.lasting(2.5, 65.0))  # several rounds of the reaper
        house.let_go("hold-import")
        eventually(lambda: house.field(name)["state"] == "ready", house.log, 120.0)
    assert len(house.redis.keys("regnf:remembered:import:*")) == 1, "one attempt"
    check_promise(house, [house.submit()])


def test_a_worker_killed_after_redis_clock_went_back(house: House, clocks: dict[str, SteppedClock]) -> None:
    """The job is found all the same: the reaper also counts by its own monotonic clock."""
    house.start_api(**clocks["api"].environment)
    first = house.start_worker(**clocks["worker"].environment)
    job_id = house.running()
    with fault():
        first.send_signal(signal.SIGKILL)
        first.wait()
        clocks["redis"].step(-HOUR_S)
        house.let_go()
        house.start_worker()
        done = check_promise(house, [job_id])
    assert done[job_id]["attempts"] == 2
