"""What the reaper finds, and what it leaves alone."""

from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import pytest
from redis import Redis
from redis.exceptions import ResponseError

from regnf_service.upkeep.reaper import Reaper
from regnf_state.records import FieldRecord, JobRecord
from regnf_state.settings import Settings
from tests.stores import HeldBlobs, ShiftedRecords, WatchedQueue

SHA = "a" * 64


@dataclass
class World:
    """Stores whose clock is moved by hand, and the reaper's own clock."""

    redis: Redis
    folder: Path
    own_time: float = 0.0

    def __post_init__(self) -> None:
        self.queue, self.blobs = WatchedQueue(self.redis), HeldBlobs(self.folder)
        self.records = ShiftedRecords(self.redis, retention_s=3600)
        self.records.frozen = self.records.now()
        self.reaper = self.new_reaper()

    @property
    def time(self) -> float:
        return self.records.now()

    @time.setter
    def time(self, moved: float) -> None:
        self.records.frozen = moved

    def new_reaper(self, lost_after_s: float = 90) -> Reaper:
        settings = Settings(lost_after_s=lost_after_s)
        return Reaper(self.records, self.queue, self.redis, settings, self.blobs, clock=lambda: self.own_time)

    def accept(self, job_id: str = "j1", queued: bool = True) -> None:
        self.records.create_job(JobRecord(job_id, "registration", "accepted", {}, {}, self.time, self.time), 100)
        if queued:
            self.queue.enqueue_registration(job_id, 1)

    def run(self, job_id: str = "j1") -> None:
        self.accept(job_id)
        self.take(job_id, 1)

    def take(self, job_id: str, attempt: int) -> None:
        self.queue.take(job_id, attempt)
        self.records.update_job(job_id, attempt, status="running")

    def upload(self, queued: bool) -> None:
        self.records.create_field(FieldRecord(SHA, "validating", 1, self.time, self.time))
        self.blobs.put(f"fields/{SHA}/original", b".")
        if queued:
            self.queue.enqueue_import(SHA)

    def after(self, seconds: float) -> dict[str, list[str]]:
        """What the last of the rounds does that are run every fifteen seconds or so; the others do nothing."""
        while seconds > 15:
            assert self.pass_by(15) == {}
            seconds -= 15
        return self.pass_by(seconds)

    def pass_by(self, seconds: float) -> dict[str, list[str]]:
        self.time += seconds
        self.own_time += seconds
        return self.reaper.run_once()


@pytest.fixture
def world(redis: Redis, tmp_path: Path) -> World:
    return World(redis, tmp_path)


def test_nothing_to_do(world: World) -> None:
    world.run("running")
    world.accept("waiting")
    world.upload(queued=True)
    assert world.after(60) == {}
    world.records.heartbeat("running", 1)
    assert world.after(60) == {}


def test_a_silent_job_is_requeued_once_and_then_lost(world: World) -> None:
    world.run()
    assert world.after(89) == {}
    assert world.after(2) == {"requeued": ["j1"]}
    assert world.queue.registrations == [("j1", 2)]
    world.take("j1", 2)
    assert world.after(90) == {"failed": ["j1"]}
    record = world.records.get_job("j1")
    assert record is not None
    assert (record.status, record.attempt, (record.error or {})["reason"]) == ("failed", 2, "WORKER_LOST")
    assert world.after(90) == {}


def test_a_job_may_be_taken_for_lost_sooner_than_rounds_come(world: World) -> None:
    world.reaper = world.new_reaper(lost_after_s=10)
    world.run()
    assert world.pass_by(15) == {}, "seen for the first time"
    assert world.pass_by(15) == {"requeued": ["j1"]}


def test_a_silent_job_that_was_to_stop_is_dismissed(world: World) -> None:
    world.run()
    world.records.request_cancel("j1")
    assert world.after(90) == {"dismissed": ["j1"]}


def test_a_job_that_never_reached_the_queue_is_queued(world: World) -> None:
    world.accept(queued=False)
    assert world.pass_by(1) == {}
    assert world.pass_by(14) == {}, "whoever recorded it may still be about to queue it"
    assert world.pass_by(1) == {"enqueued": ["j1"]}
    assert world.queue.registrations == [("j1", 1)]
    assert world.after(60) == {}


def test_a_lost_import_is_tried_again_and_given_up_at_last(world: World) -> None:
    world.upload(queued=False)
    for attempt in (2, 3):
        assert world.pass_by(15) == {}
        assert world.pass_by(15) == {"requeued": [SHA]}
        assert world.queue.imports == [(SHA, attempt)]
        world.queue.lose()
    assert world.after(30) == {"failed": [SHA]}
    record = world.records.get_field(SHA)
    assert record is not None
    assert (record.state, (record.error or {})["reason"]) == ("rejected", "WORKER_LOST")
    assert world.blobs.blobs == {}


def test_expired_results_go(world: World) -> None:
    world.run()
    world.records.update_job("j1", 1, status="successful")
    world.blobs.put("jobs/j1/manifest.json", b".")
    world.blobs.put("jobs/j10/manifest.json", b".")
    assert world.after(3599) == {}
    assert world.after(2) == {"expired": ["j1"]}
    assert list(world.blobs.blobs) == ["jobs/j10/manifest.json"]
    assert world.records.job_expired("j1")


def test_heartbeats_get_time_to_come_again_after_an_outage(world: World) -> None:
    world.run()
    world.after(15)
    world.time += 120
    world.own_time += 120
    assert world.reaper.run_once() == {}, "nobody could beat, and nobody could look"
    assert world.after(14) == {}
    assert world.after(1) == {"requeued": ["j1"]}


def test_a_round_that_failed_begins_the_counting_anew(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """Redis refuses writes for less time than rounds may be apart: workers could not write either."""
    world.run()
    assert world.after(75) == {}
    with monkeypatch.context() as full:
        full.setattr(world.redis, "lock", refused)
        with pytest.raises(ResponseError):
            world.pass_by(10)
    assert world.pass_by(10) == {}, "95 seconds without a heartbeat, but who could write one?"
    assert world.pass_by(14) == {}
    assert world.pass_by(1) == {"requeued": ["j1"]}


def test_a_round_that_fails_at_its_end_hides_no_dead_job(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """Here one step of every round is refused, and heartbeats could have been written."""
    world.run()
    monkeypatch.setattr(world.records, "expire_jobs", refused)
    for _ in range(7):
        with pytest.raises(ResponseError):
            world.pass_by(15)
    assert world.queue.registrations == [("j1", 2)]


def refused(*_given: object, **_named: object) -> NoReturn:
    raise ResponseError("MISCONF Errors writing to the AOF file: No space left on device")


def test_a_reaper_that_has_just_begun_does_not_know_who_was_silent(world: World) -> None:
    world.run()
    world.after(60)
    world.time += 60
    world.reaper = world.new_reaper()
    assert world.after(0) == {}
    assert world.after(15) == {"requeued": ["j1"]}


@pytest.mark.parametrize("step", [3600.0, -3600.0])
def test_a_step_of_the_records_clock_loses_no_living_job(world: World, step: float) -> None:
    world.run()
    world.after(15)
    world.time += step
    assert world.pass_by(1) == {}
    world.records.heartbeat("j1", 1)
    assert world.after(89) == {}


@pytest.mark.parametrize("step", [3600.0, -3600.0])
def test_a_step_of_the_records_clock_hides_no_dead_job(world: World, step: float) -> None:
    world.run("dead")
    world.accept("lost", queued=False)
    world.after(14)
    world.time += step
    rounds = [world.pass_by(15) for _ in range(8)]
    assert [one["requeued"] for one in rounds if "requeued" in one] == [["dead"]]
    assert [one["enqueued"] for one in rounds if "enqueued" in one] == [["lost"]]


def test_one_process_at_a_time(world: World, redis: Redis) -> None:
    world.run()
    world.after(75)
    redis.set("regnf:reaper", "another", ex=60)
    assert world.after(15) == {}
    assert redis.get("regnf:reaper") == b"another", "its lock is not ours to release"
    redis.delete("regnf:reaper")
    assert world.after(0) == {"requeued": ["j1"]}
    assert not redis.exists("regnf:reaper")
