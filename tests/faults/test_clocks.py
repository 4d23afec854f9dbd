"""Wall clocks that are stepped by an hour. The first line of each test says what the service makes of it."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from email.utils import parsedate_to_datetime
from pathlib import Path

import pytest
from rq.utils import utcparse

from tests.contract.world import field_bytes
from tests.faults.clock import SteppedClock, stepped_clock
from tests.faults.conftest import house_over
from tests.faults.house import House
from tests.faults.pace import pace
from tests.faults.promise import check_promise, fault
from tests.faults.stores import Folder
from tests.restartable_redis import restartable_redis
from tests.worker.bench import eventually

pytestmark = pytest.mark.long
Clocks = dict[str, SteppedClock]
HOUR_S = 3600
ONE_AFTER_THE_OTHER = [{name: step} for name in ("redis", "api", "worker") for step in (HOUR_S, -HOUR_S)]
AT_ONCE = [{"redis": -HOUR_S, "api": HOUR_S, "worker": HOUR_S}]
STEPS = pytest.mark.parametrize("steps", ONE_AFTER_THE_OTHER if pace().whole else AT_ONCE, ids=str)


@pytest.fixture
def clocks(tmp_path: Path) -> Clocks:
    return {name: stepped_clock(tmp_path, name) for name in ("redis", "api", "worker")}


@pytest.fixture
def house(tmp_path: Path, clocks: Clocks) -> Iterator[House]:
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
        seen = utcparse(str(house.redis.hget(key, "last_heartbeat"), "utf-8")).timestamp()
    return abs(seen - time.time() - step) < HOUR_S / 2


@STEPS
def test_a_clock_stepped_during_a_job(house: House, clocks: Clocks, steps: dict[str, int]) -> None:
    """Nothing happens: leases and heartbeats are Redis' own, and nobody is lost whose heartbeat is seen to change."""
    house.start_api(**clocks["api"].environment)
    worker = house.start_worker(**clocks["worker"].environment)
    job_id = house.running()
    waiting = house.submit(1)
    with fault() as one:
        for clock, step in steps.items():
            clocks[clock].step(step)
            eventually(lambda clock=clock, step=step: is_off_by(house, clock, step), clock)
        time.sleep(house.pace.lasting(1.2, 35.0))  # two rounds of the reaper
        one.over()
        house.let_go()
        done = check_promise(house, [job_id, waiting])
    assert [job["attempts"] for job in done.values()] == [1, 1]
    assert worker.poll() is None


@STEPS
def test_a_clock_stepped_during_an_import(house: House, clocks: Clocks, steps: dict[str, int]) -> None:
    """The import goes on, and is done once."""
    house.start_api(**clocks["api"].environment)
    house.start_worker(**clocks["worker"].environment)
    house.hold("hold-import")
    name = house.upload(field_bytes("scene"))
    eventually(lambda: house.redis.keys("regnf:once:import:*"), house.log)  # it was claimed
    with fault() as one:
        for clock, step in steps.items():
            clocks[clock].step(step)
        time.sleep(house.pace.lasting(2.5, 65.0))  # several rounds of the reaper
        one.over()
        house.let_go("hold-import")
        eventually(lambda: house.field(name)["state"] == "ready", house.log, 120.0)
    assert len(house.redis.keys("regnf:once:import:*")) == 1, "one attempt"
    check_promise(house, [house.submit()])


def test_a_worker_killed_after_redis_clock_went_back(house: House, clocks: Clocks) -> None:
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
