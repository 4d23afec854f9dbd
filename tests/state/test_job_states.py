"""A job's record: its states and attempts, kept alike by the store in memory and the one in Redis."""

import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest

from regnf_state.records import StaleAttemptError
from regnf_state.redis.jobs import RecordStore
from tests.state.record_makers import finished, job, started

# jobs: the state machine


def test_a_job_runs_its_course(store: RecordStore) -> None:
    accepted, created = store.create_job(job(store), 10)
    assert created
    assert store.get_job("j1") == accepted
    running = store.update_job("j1", 1, status="running", phase="loading", engine={"version": "0"})
    assert running.started is not None
    assert running.heartbeat == running.started >= accepted.created
    optimizing = store.update_job("j1", 1, phase="optimizing", progress=0.5)
    assert (optimizing.phase, optimizing.progress) == ("optimizing", 0.5)
    done = store.update_job("j1", 1, status="successful")
    assert (done.status, done.progress, done.error) == ("successful", 1.0, None)
    assert done.finished is not None
    assert done.version == 4
    assert store.get_job("j1") == done


def test_what_is_asked_twice_is_one_job(store: RecordStore) -> None:
    first, _ = store.create_job(job(store), 10)
    again, created = store.create_job(replace(job(store), request={"other": 1}), 10)
    assert (again, created) == (first, False)


@pytest.mark.parametrize("status", ["failed", "dismissed"])
def test_a_job_without_result_is_started_anew(store: RecordStore, status: str) -> None:
    before = finished(store, status)
    again, created = store.create_job(job(store), 10)
    assert created
    assert (again.status, again.attempt, again.error, again.progress) == ("accepted", 2, None, 0.0)
    assert (again.finished, again.started, again.cancel_requested) == (None, None, False)
    assert again.created == before.created
    assert store.update_job("j1", 2, status="running").attempt == 2


def test_a_successful_job_is_never_started_anew(store: RecordStore) -> None:
    done = finished(store, "successful")
    assert store.create_job(job(store), 10) == (done, False)


@pytest.mark.parametrize("status", ["successful", "failed", "dismissed"])
def test_nothing_changes_a_finished_job(store: RecordStore, status: str) -> None:
    done = finished(store, status)
    for change in ({"status": "running"}, {"status": "failed"}, {"phase": "optimizing"}, {"progress": 0.9}):
        with pytest.raises(StaleAttemptError):
            store.update_job("j1", 1, **change)
    with pytest.raises(StaleAttemptError):
        store.heartbeat("j1", 1)
    with pytest.raises(StaleAttemptError):
        store.requeue_job("j1", 1)
    assert store.request_cancel("j1") == done
    assert store.get_job("j1") == done


def test_success_needs_a_run(store: RecordStore) -> None:
    store.create_job(job(store), 10)
    with pytest.raises(StaleAttemptError):
        store.update_job("j1", 1, status="successful")


def test_progress_never_falls(store: RecordStore) -> None:
    started(store)
    store.update_job("j1", 1, progress=0.7)
    assert store.update_job("j1", 1, progress=0.2).progress == 0.7
    assert store.update_job("j1", 1, progress=7).progress == 1.0


def test_only_what_may_change_changes(store: RecordStore) -> None:
    started(store)
    for name in ("attempt", "version", "id", "created", "request"):
        with pytest.raises(TypeError):
            store.update_job("j1", 1, **{name: 5})


def test_of_several_claims_one_wins(store: RecordStore) -> None:
    store.create_job(job(store), 10)
    barrier = threading.Barrier(8)

    def claim(_: int) -> bool:
        barrier.wait()
        try:
            store.update_job("j1", 1, status="running")
        except StaleAttemptError:
            return False
        return True

    with ThreadPoolExecutor(8) as pool:
        assert sum(pool.map(claim, range(8))) == 1


def test_no_change_is_lost_among_concurrent_ones(store: RecordStore) -> None:
    started(store)
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda _: store.heartbeat("j1", 1), range(40)))
    record = store.get_job("j1")
    assert record is not None
    assert record.version == 42


def test_unknown_jobs(store: RecordStore) -> None:
    assert store.get_job("j9") is None
    assert store.request_cancel("j9") is None
    assert not store.delete_job("j9")
    assert not store.job_expired("j9")
    assert store.events("j9", None) == []
    with pytest.raises(StaleAttemptError):
        store.update_job("j9", 1, phase="loading")


# jobs: attempts


def test_a_requeued_job_fences_off_its_older_attempt(store: RecordStore) -> None:
    started(store)
    again = store.requeue_job("j1", 1)
    assert (again.status, again.attempt, again.requeues, again.phase) == ("accepted", 2, 1, None)
    for write in (store.heartbeat, store.requeue_job):
        with pytest.raises(StaleAttemptError):
            write("j1", 1)
    with pytest.raises(StaleAttemptError):
        store.update_job("j1", 1, status="successful")


def test_work_given_back_in_good_order_does_not_count_as_lost(store: RecordStore) -> None:
    started(store)
    assert store.requeue_job("j1", 1, lost=False).requeues == 0


def test_heartbeats(store: RecordStore) -> None:
    store.create_job(job(store), 10)
    with pytest.raises(StaleAttemptError):
        store.heartbeat("j1", 1)
    before = store.update_job("j1", 1, status="running").heartbeat
    assert before is not None
    after = store.heartbeat("j1", 1).heartbeat
    assert after is not None
    assert before <= after <= store.now()


def test_cancelling(store: RecordStore) -> None:
    store.create_job(job(store, "waiting"), 10)
    dismissed = store.request_cancel("waiting")
    assert dismissed is not None
    assert (dismissed.status, dismissed.cancel_requested) == ("dismissed", True)
    started(store, "running")
    asked = store.request_cancel("running")
    assert asked is not None
    assert (asked.status, asked.cancel_requested) == ("running", True)
    assert store.request_cancel("running") == asked
    assert store.heartbeat("running", 1).cancel_requested
    assert store.update_job("running", 1, status="dismissed").finished is not None
