"""What the journal remembers of jobs, and how their records are made anew from it."""

import threading
from dataclasses import replace
from pathlib import Path

import pytest
from redis import Redis

from regnf_state.blobs.base import StorageUnavailableError
from regnf_state.journal.journaled_records import Rebuilt
from regnf_state.records import JobRecord, StaleAttemptError
from regnf_state.redis.webhook_outbox import RedisOutbox
from tests.state.journal_world import RETENTION_S, World, fresh_world


@pytest.fixture
def world(redis: Redis, tmp_path: Path) -> World:
    return fresh_world(redis, tmp_path)


def same_but_version(first: JobRecord, second: JobRecord) -> bool:
    return replace(first, version=0) == replace(second, version=0)


def test_a_waiting_job_comes_back_and_is_queued(world: World) -> None:
    accepted = world.accept()
    assert world.lose_redis() == Rebuilt(jobs=("j1",))
    assert same_but_version(world.job(), replace(accepted, attempt=2))
    assert world.queue.registrations == [("j1", 2)]
    assert world.rebuilder.run_if_needed() == Rebuilt(), "once is enough"


def test_jobs_come_back_in_their_order(world: World) -> None:
    now = world.records.now()
    for number, job_id in enumerate(("z", "m", "a")):
        world.accept(job_id, now + number)
    world.lose_redis()
    assert [job_id for job_id, _ in world.queue.registrations] == ["z", "m", "a"]


def test_a_running_job_comes_back_as_an_attempt_that_nobody_has_had(world: World) -> None:
    world.accept()
    world.run()
    world.records.requeue_job("j1", 1)
    world.run(attempt=2)
    world.lose_redis()
    assert (world.job().status, world.job().attempt) == ("accepted", 3)
    for stale in (1, 2):
        with pytest.raises(StaleAttemptError):
            world.records.heartbeat("j1", stale)


@pytest.mark.parametrize("status", ["successful", "failed", "dismissed"])
def test_an_ended_job_comes_back_as_it_ended(world: World, status: str) -> None:
    world.accept()
    world.run()
    ended = world.end(status)
    assert world.lose_redis() == Rebuilt(jobs=("j1",))
    assert same_but_version(world.job(), ended)
    assert world.queue.registrations == []


@pytest.mark.parametrize("added_to", ["accepted", "running", "requeued", "successful", "failed"])
def test_webhooks_of_later_requests_come_back(world: World, added_to: str) -> None:
    world.accept(webhook="first")
    if added_to != "accepted":
        world.run()
    if added_to == "requeued":
        world.records.requeue_job("j1", 1)
    if added_to in ("successful", "failed"):
        world.end(added_to)
    for url in ("second", "third", "second"):
        world.accept(webhook=url)
    added = {"first", "second", "third"}
    assert set(world.job().webhooks) == added
    for _ in range(2):
        world.lose_redis()
        assert set(world.job().webhooks) == added
        assert len(world.job().webhooks) == 3
    assert RedisOutbox(world.redis).waiting() == (3 if added_to == "successful" else 0)


def test_an_older_attempts_webhooks_are_not_counted_twice(world: World) -> None:
    world.accept()
    world.accept(webhook="first")
    world.accept(webhook="second")
    world.run()
    world.end("failed")
    world.accept(webhook="first")
    assert world.job().webhooks == ["first", "second"]
    world.lose_redis()
    assert world.job().webhooks == ["first", "second"]


def test_a_webhook_is_not_taken_when_the_journal_takes_nothing(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    world.accept()
    world.run()

    def unwritable(*_: object) -> bool:
        raise StorageUnavailableError("no")

    with monkeypatch.context() as patched:
        patched.setattr(world.blobs, "put_if_absent", unwritable)
        with pytest.raises(StorageUnavailableError):
            world.accept(webhook="late")
    world.accept(webhook="late")
    world.lose_redis()
    assert world.job().webhooks == ["late"]


def test_a_waiting_job_that_was_cancelled_stays_so(world: World) -> None:
    world.accept()
    world.records.request_cancel("j1")
    world.lose_redis()
    assert world.job().status == "dismissed"


def test_a_result_that_stands_counts_though_nobody_said_so(world: World) -> None:
    world.accept()
    world.run()
    world.blobs.put("jobs/j1/manifest.json", b"{}")
    world.lose_redis()
    assert (world.job().status, world.job().progress) == ("successful", 1.0)
    assert world.job().finished is not None
    assert world.queue.registrations == []


def test_a_failed_job_that_was_asked_for_again_is_run_again(world: World) -> None:
    world.accept()
    world.run()
    world.end("failed")
    assert world.accept().attempt == 2
    world.lose_redis()
    assert (world.job().status, world.job().attempt, world.job().error) == ("accepted", 3, None)


def test_what_has_outlived_its_retention_is_dropped_instead(world: World) -> None:
    world.accept(created=1.0)
    world.run()
    world.blobs.put("jobs/j1/1/result.json", b"{}")
    world.records.journal.end(replace(world.job(), status="successful", finished=world.records.now() - RETENTION_S - 1))
    assert world.lose_redis() == Rebuilt(dropped=1)
    assert list(world.blobs.list("jobs")) == []
    assert list(world.records.journal.jobs()) == []


def test_a_deleted_job_stays_deleted(world: World) -> None:
    world.accept()
    world.run()
    world.end("failed")
    world.records.delete_job("j1")
    assert world.lose_redis() == Rebuilt()
    assert world.records.get_job("j1") is None


def test_a_job_is_known_before_the_journal_was_read(world: World) -> None:
    """Between the loss and the reaper's next round callers look for their jobs, and send requests again."""
    world.accept()
    world.run()
    world.redis.flushall()
    assert world.job().attempt == 2
    world.redis.flushall()
    assert world.accept().attempt == 2, "not the first again: somebody may still be at that"


def test_a_job_of_the_same_id_after_the_first_has_expired(world: World) -> None:
    world.accept(created=1.0)
    world.run()
    world.end("failed")
    world.redis.delete("regnf:job:j1")  # as its expiry does, before the reaper's round
    again = world.accept()
    world.lose_redis()
    assert (world.job().status, world.job().created) == ("accepted", again.created)


def test_two_machines_read_the_journal_at_once(world: World) -> None:
    for number in range(20):
        world.accept(f"j{number}")
    world.field()
    world.redis.flushall()
    other = World(world.redis, world.blobs)
    found: list[Rebuilt] = []
    threads = [
        threading.Thread(target=lambda one=one: found.append(one.rebuilder.run_if_needed())) for one in (world, other)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    jobs = [job_id for rebuilt in found for job_id in rebuilt.jobs]
    assert sorted(jobs) == sorted(f"j{number}" for number in range(20)), "each by one of them"
    assert {world.job(job_id).attempt for job_id in jobs} == {2}
    assert sorted(world.queue.registrations) == sorted((job_id, 2) for job_id in jobs)
    assert world.records.generation.is_current()


def test_redis_lost_again_while_the_journal_is_read(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    world.accept()
    recall = world.records.journal.recall

    def interrupted(job_id: str, now: float) -> JobRecord | None:
        world.redis.flushall()
        monkeypatch.setattr(world.records.journal, "recall", recall)
        return recall(job_id, now)

    monkeypatch.setattr(world.records.journal, "recall", interrupted)
    world.lose_redis()
    world.redis.flushall()
    assert not world.records.generation.is_current()
    assert world.rebuilder.run_if_needed() == Rebuilt(jobs=("j1",))


def test_a_restart_of_redis_is_noticed(world: World) -> None:
    """It may have lost its last second: the journal is compared once more, and what is there is left alone."""
    world.accept()
    world.run()
    world.redis.set("regnf:generation", f"{world.records.journal.storage_id()}:another-run")
    world.redis.delete("regnf:job:j1")
    assert world.rebuilder.run_if_needed() == Rebuilt(jobs=("j1",))
    world.run(attempt=2)
    world.redis.set("regnf:generation", "another-store:another-run")
    assert world.rebuilder.run_if_needed() == Rebuilt()
    assert world.job().status == "running"


def test_damage_to_one_entry_is_no_harm_to_the_others(world: World) -> None:
    world.accept("bad")
    world.accept("good")
    world.blobs.put("journal/jobs/bad/000001-accepted", b"{")
    assert world.lose_redis() == Rebuilt(jobs=("good",))


def test_a_job_is_not_accepted_when_the_journal_takes_nothing(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(key: str, data: bytes) -> bool:
        raise StorageUnavailableError("away")

    with monkeypatch.context() as patch:
        patch.setattr(world.blobs, "put_if_absent", refuse)
        with pytest.raises(StorageUnavailableError):
            world.accept()
    world.accept()
    world.lose_redis()
    assert world.job().status == "accepted"


def test_an_end_that_cannot_be_journaled_stands_all_the_same(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    world.accept()
    world.run()

    def refuse(key: str, data: bytes) -> bool:
        raise StorageUnavailableError("away")

    monkeypatch.setattr(world.blobs, "put_if_absent", refuse)
    assert world.end("failed").status == "failed"
