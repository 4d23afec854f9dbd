"""The promises of a record store, kept alike by the one in memory and the one in Redis."""

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest

from service.memory import InMemoryRecordStore
from service.ownership import reference_of
from service.records import FieldRecord, JobRecord, QueueFullError, Quota, QuotaError, RecordStore, StaleAttemptError
from service.redis_client import connect
from service.redis_records import RedisRecordStore
from tests.redis_server import private_redis

SCENE, OBJECT = "a" * 64, "b" * 64


@pytest.fixture(scope="module")
def redis_url() -> Iterator[str]:
    with private_redis() as url:
        yield url


@pytest.fixture(params=["memory", "redis"])
def store(request: pytest.FixtureRequest) -> Iterator[RecordStore]:
    if request.param == "memory":
        yield InMemoryRecordStore()
        return
    with connect(request.getfixturevalue("redis_url")) as redis:
        redis.flushall()
        yield RedisRecordStore(redis)


def job(store: RecordStore, name: str = "j1", created: float | None = None) -> JobRecord:
    now = store.now()
    created = now if created is None else created
    request = {"scene": SCENE, "object": OBJECT}
    return JobRecord(name, "registration", "accepted", request, {"scene": SCENE}, created=created, updated=now)


def field(
    store: RecordStore, sha256: str = SCENE, created: float | None = None, label: str | None = None
) -> FieldRecord:
    now = store.now()
    return FieldRecord(sha256, "validating", 10, now if created is None else created, now, label=label)


def started(store: RecordStore, name: str = "j1") -> JobRecord:
    store.create_job(job(store, name), 10)
    return store.update_job(name, 1, status="running", phase="loading")


def finished(store: RecordStore, status: str, name: str = "j1") -> JobRecord:
    started(store, name)
    return store.update_job(name, 1, status=status, error={"reason": "WORKER_LOST"} if status == "failed" else None)


# jobs: the state machine


def test_a_job_runs_its_course(store: RecordStore) -> None:
    accepted, created = store.create_job(job(store), 10)
    assert created
    assert store.get_job("j1") == accepted
    running = store.update_job("j1", 1, status="running", phase="loading", engine={"version": "0"})
    assert running.started is not None
    assert running.heartbeat == running.started >= accepted.created
    optimising = store.update_job("j1", 1, phase="optimising", progress=0.5)
    assert (optimising.phase, optimising.progress) == ("optimising", 0.5)
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
    assert store.queue_position("j1") == 1
    assert store.update_job("j1", 2, status="running").attempt == 2


def test_a_successful_job_is_never_started_anew(store: RecordStore) -> None:
    done = finished(store, "successful")
    assert store.create_job(job(store), 10) == (done, False)


@pytest.mark.parametrize("status", ["successful", "failed", "dismissed"])
def test_nothing_changes_a_finished_job(store: RecordStore, status: str) -> None:
    done = finished(store, status)
    for change in ({"status": "running"}, {"status": "failed"}, {"phase": "optimising"}, {"progress": 0.9}):
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
    assert store.queue_position("j9") is None
    assert not store.job_expired("j9")
    assert store.events("j9", None, 0) == []
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
    assert store.queue_position("j1") == 1


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
    assert store.queue_position("waiting") is None
    started(store, "running")
    asked = store.request_cancel("running")
    assert asked is not None
    assert (asked.status, asked.cancel_requested) == ("running", True)
    assert store.request_cancel("running") == asked
    assert store.heartbeat("running", 1).cancel_requested
    assert store.update_job("running", 1, status="dismissed").finished is not None


# jobs: how many, which, in what order


def test_the_cap_counts_active_jobs_only(store: RecordStore) -> None:
    store.create_job(job(store, "a"), 2)
    started(store, "b")
    with pytest.raises(QueueFullError):
        store.create_job(job(store, "c"), 2)
    assert store.get_job("c") is None
    assert store.create_job(job(store, "a"), 2)[1] is False
    store.update_job("b", 1, status="failed")
    store.create_job(job(store, "c"), 2)
    with pytest.raises(QueueFullError):
        store.create_job(job(store, "b"), 2)
    assert sorted(record.id for record in store.active_jobs()) == ["a", "c"]


def test_the_cap_holds_under_concurrent_requests(store: RecordStore) -> None:
    def create(number: int) -> bool:
        try:
            return store.create_job(job(store, f"j{number}"), 5)[1]
        except QueueFullError:
            return False

    with ThreadPoolExecutor(8) as pool:
        assert sum(pool.map(create, range(20))) == 5
    assert len(store.active_jobs()) == 5


def test_queue_positions_follow_acceptance(store: RecordStore) -> None:
    for name in ("a", "b", "c"):
        store.create_job(job(store, name), 10)
    assert [store.queue_position(name) for name in "abc"] == [1, 2, 3]
    store.update_job("a", 1, status="running")
    assert [store.queue_position(name) for name in "abc"] == [None, 1, 2]
    store.requeue_job("a", 1)
    assert [store.queue_position(name) for name in "abc"] == [3, 1, 2]


def test_listing_pages_through_every_job_once(store: RecordStore) -> None:
    times = [5.0, 5.0, 7.0, 5.0, 6.0]
    for number, created in enumerate(times):
        store.create_job(job(store, f"j{number}", created), 10)
    expected = ["j2", "j4", "j3", "j1", "j0"]
    assert [record.id for record in store.list_jobs(None, 10, None)] == expected
    seen: list[str] = []
    before = None
    while page := store.list_jobs(None, 2, before):
        seen += [record.id for record in page]
        before = (page[-1].created, page[-1].id)
    assert seen == expected
    store.update_job("j4", 1, status="running")
    assert [record.id for record in store.list_jobs("running", 10, None)] == ["j4"]
    assert len(store.list_jobs("accepted", 10, None)) == 4


def test_long_listings_with_equal_times(store: RecordStore) -> None:
    for number in range(230):
        store.create_field(field(store, f"{number:064d}", created=1.0 if number < 215 else float(number)))
    listed = [record.sha256 for record in store.list_fields(None, 1000, None)]
    assert listed == [f"{number:064d}" for number in reversed(range(230))]


# jobs: events


def test_events_tell_every_change_that_shows(store: RecordStore) -> None:
    started(store)
    store.update_job("j1", 1, phase="sampling")
    store.update_job("j1", 1, progress=0.5)
    store.update_job("j1", 1, engine={"version": "1"})
    store.heartbeat("j1", 1)
    store.update_job("j1", 1, status="failed", error={"reason": "NO_SURFACE_IN_OBJECT"})
    events = store.events("j1", None, 0)
    assert [event.name for event in events] == ["status", "status", "progress", "progress", "status"]
    assert [event.data["phase"] for event in events] == [None, "loading", "sampling", "sampling", "sampling"]
    assert events[3].data["progress"] == 0.5
    assert events[-1].data["error"] == {"reason": "NO_SURFACE_IN_OBJECT"}
    assert store.events("j1", events[1].id, 0) == events[2:]
    assert store.events("j1", events[-1].id, 0) == []


def test_waiting_for_events(store: RecordStore) -> None:
    started(store)
    last = store.events("j1", None, 0)[-1].id
    assert store.events("j1", last, 0.05) == []
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(store.events, "j1", last, 30)
        store.update_job("j1", 1, progress=0.5)
        assert [event.data["progress"] for event in waiting.result()] == [0.5]


@pytest.mark.parametrize("after", ["", "x", "1-x", "-1", "1-2-3", "9" * 30, "1 ", "²"])
def test_odd_event_ids_are_refused(store: RecordStore, after: str) -> None:
    started(store)
    with pytest.raises(ValueError):
        store.events("j1", after, 0)


# jobs: the end


def test_deleting(store: RecordStore) -> None:
    started(store)
    with pytest.raises(StaleAttemptError):
        store.delete_job("j1")
    store.update_job("j1", 1, status="failed")
    assert store.delete_job("j1")
    assert store.get_job("j1") is None
    assert store.events("j1", None, 0) == []
    assert store.list_jobs(None, 10, None) == []
    assert not store.job_expired("j1")
    assert store.create_job(job(store), 10)[0].attempt == 1


def test_finished_jobs_expire_and_are_remembered_as_gone_in_memory() -> None:
    time = [1000.0]
    store = InMemoryRecordStore(retention_s=60, clock=lambda: time[0])
    _assert_expiry(store, lambda: time.__setitem__(0, time[0] + 61))


def test_finished_jobs_expire_and_are_remembered_as_gone_in_redis(redis_url: str) -> None:
    with connect(redis_url) as redis:
        redis.flushall()
        store = RedisRecordStore(redis, retention_s=2)

        def wait() -> None:
            gone = threading.Event()
            while store.get_job("done") is not None:
                gone.wait(0.05)

        _assert_expiry(store, wait)
        assert set(redis.keys()) - {b"regnf:job:waiting", b"regnf:job:waiting:events"} == {
            b"regnf:job:done:gone",
            b"regnf:jobs:created",
            b"regnf:jobs:created:anonymous",
            b"regnf:owner:anonymous:active",
            b"regnf:figures",
            b"regnf:jobs:active",
            b"regnf:jobs:waiting",
        }


def _assert_expiry(store: RecordStore, wait) -> None:  # type: ignore[no-untyped-def]
    finished(store, "successful", "done")
    store.create_job(job(store, "waiting"), 10)
    assert store.expire_jobs() == []
    assert not store.job_expired("done")
    wait()
    assert store.get_job("done") is None
    assert store.job_expired("done"), "even before anybody cleaned up"
    assert store.expire_jobs() == ["done"]
    assert store.expire_jobs() == []
    assert store.job_expired("done")
    assert store.get_job("waiting") is not None
    assert not store.job_expired("waiting")
    assert [record.id for record in store.list_jobs(None, 10, None)] == ["waiting"]


def test_an_expired_job_can_be_asked_for_again() -> None:
    time = [1000.0]
    store = InMemoryRecordStore(retention_s=60, clock=lambda: time[0])
    finished(store, "successful")
    time[0] += 61
    assert store.create_job(job(store), 10)[1]
    assert store.expire_jobs() == []
    assert not store.job_expired("j1")


# fields


def test_a_field_becomes_ready(store: RecordStore) -> None:
    record, created = store.create_field(field(store, label="room"))
    assert created
    assert store.validating_fields() == [record]
    assert store.create_field(field(store)) == (record, False)
    ready = store.update_field(SCENE, state="ready", report={"family": "neus-facto"})
    assert store.get_field(SCENE) == ready
    assert (ready.state, ready.version) == ("ready", 2)
    assert store.validating_fields() == []
    with pytest.raises(StaleAttemptError):
        store.update_field(SCENE, state="rejected")
    assert store.update_field(SCENE, label="hall").label == "hall"
    assert store.create_field(field(store))[1] is False


def test_a_rejected_field_starts_anew(store: RecordStore) -> None:
    first, _ = store.create_field(field(store))
    store.update_field(SCENE, attempt=1, state="rejected", error={"reason": "FIELD_NOT_RECOGNISED"})
    again, created = store.create_field(replace(field(store), description={"family": "neus-facto"}))
    assert created
    assert (again.state, again.attempt, again.error) == ("validating", 2, None)
    assert again.description == {"family": "neus-facto"}
    assert again.created == first.created
    with pytest.raises(StaleAttemptError):
        store.update_field(SCENE, attempt=1, state="ready")
    assert store.update_field(SCENE, attempt=2, state="ready").state == "ready"


def test_a_lost_import_starts_anew(store: RecordStore) -> None:
    store.create_field(field(store))
    again = store.retry_import(SCENE, 1)
    assert (again.attempt, again.requeues) == (2, 1)
    assert store.retry_import(SCENE, 2, lost=False).requeues == 1
    with pytest.raises(StaleAttemptError):
        store.retry_import(SCENE, 1)
    store.update_field(SCENE, state="ready")
    with pytest.raises(StaleAttemptError):
        store.retry_import(SCENE, 3)


def test_a_field_that_was_deleted_counts_its_attempts_on(store: RecordStore) -> None:
    store.create_field(field(store))
    store.retry_import(SCENE, 1)
    assert store.delete_field(SCENE)
    again, created = store.create_field(field(store))
    assert (created, again.attempt, again.requeues) == (True, 3, 0)
    for old in (1, 2):
        with pytest.raises(StaleAttemptError):
            store.update_field(SCENE, attempt=old, state="rejected")


def test_fields_are_listed_and_deleted(store: RecordStore) -> None:
    for number, label in enumerate(["chair", "table", "chair"]):
        store.create_field(field(store, str(number) * 64, float(number), label))
    assert [record.sha256[0] for record in store.list_fields(None, 10, None)] == ["2", "1", "0"]
    assert [record.sha256[0] for record in store.list_fields("chair", 1, None)] == ["2"]
    assert [record.sha256[0] for record in store.list_fields("chair", 10, (2.0, "2" * 64))] == ["0"]
    assert store.delete_field("1" * 64)
    assert not store.delete_field("1" * 64)
    assert len(store.list_fields(None, 10, None)) == 2
    assert store.get_field("1" * 64) is None
    with pytest.raises(StaleAttemptError):
        store.update_field("1" * 64, label="x")


def test_active_jobs_hold_their_fields(store: RecordStore) -> None:
    started(store)
    assert list(store.jobs_using_field(SCENE)) == ["j1"]
    assert list(store.jobs_using_field(OBJECT)) == ["j1"]
    assert list(store.jobs_using_field("c" * 64)) == []
    store.update_job("j1", 1, status="successful")
    assert list(store.jobs_using_field(SCENE)) == []


# the rest


def test_remembering_binds_once(store: RecordStore) -> None:
    assert store.remember("key", "first", 60) == "first"
    assert store.remember("key", "second", 60) == "first"
    assert store.remember("other", "second", 60) == "second"
    assert store.ping()


def test_a_script_run_twice_by_a_broken_connection_counts_once(redis_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The client repeats a script when it never saw the answer: the second run must neither fail nor apply again."""
    with connect(redis_url) as redis:
        redis.flushall()
        store = RedisRecordStore(redis)
        store.create_job(job(store), 10)
        script = store._write

        def twice(**arguments: object) -> object:
            script(**arguments)
            return script(**arguments)

        monkeypatch.setattr(store, "_write", twice)
        assert store.update_job("j1", 1, status="running").status == "running"
        assert store.heartbeat("j1", 1).version == 3
        assert len(store.events("j1", None, 0)) == 2


def test_text_of_any_kind_survives(store: RecordStore) -> None:
    odd = 'ü "quoted" \\ \n \u2028 \ud83d\ude00 \x00'.encode("utf-16", "surrogatepass").decode("utf-16")
    store.create_job(replace(job(store), request={"scene": SCENE, "label": odd}), 10)
    record = store.update_job("j1", 1, status="running", engine={"label": odd})
    assert store.get_job("j1") == record
    assert record.request["label"] == odd


# whose they are


def test_lists_and_tombstones_are_each_owners_own(store: RecordStore) -> None:
    for owner, created in (("alice", 1.0), ("bob", 2.0), ("anonymous", 3.0)):
        scene = reference_of(owner, SCENE)
        store.create_field(field(store, scene, created))
        store.create_job(replace(job(store, f"job-of-{owner}", created), request={"scene": scene}), 10)
    assert [record.sha256 for record in store.list_fields(None, 10, None, "alice")] == [f"{SCENE}_alice"]
    assert [record.id for record in store.list_jobs(None, 10, None, "bob")] == ["job-of-bob"]
    assert [record.id for record in store.list_jobs(None, 10, None, "carol")] == []
    assert len(store.list_fields(None, 10, None)) == len(store.list_jobs(None, 10, None)) == 3
    store.update_job("job-of-bob", 1, status="failed", error={"reason": "INTERNAL"})
    store.delete_job("job-of-bob")
    store.delete_field(f"{SCENE}_alice")
    assert store.list_jobs(None, 10, None, "bob") == store.list_fields(None, 10, None, "alice") == []


def test_an_expired_job_is_so_to_its_owner_alone(redis_url: str) -> None:
    with connect(redis_url) as redis:
        redis.flushall()
        store = RedisRecordStore(redis, retention_s=0)
        store.create_job(replace(job(store), request={"scene": reference_of("alice", SCENE)}), 10)
        store.update_job("j1", 1, status="failed", error={"reason": "INTERNAL"})
        redis.set("regnf:job:j1:gone", "alice")  # with no retention at all the tombstone would be gone as well
        redis.delete("regnf:job:j1")
        assert store.job_expired("j1", "alice")
        assert not store.job_expired("j1", "bob")
        assert not store.job_expired("j1")
        assert store.expire_jobs() == ["j1"]
        assert store.list_jobs(None, 10, None, "alice") == []
        assert not redis.exists("regnf:jobs:created:alice")


# how much they may have


def test_an_owner_has_no_more_than_its_quota(store: RecordStore) -> None:
    quota = Quota(active_jobs=1, fields=2, stored_bytes=25)
    mine = [reference_of("alice", digit * 64) for digit in "1234"]
    store.create_job(replace(job(store), request={"scene": mine[0]}), 10, quota)
    with pytest.raises(QuotaError, match="QUOTA_ACTIVE_JOBS"):
        store.create_job(replace(job(store, "j2"), request={"scene": mine[0]}), 10, quota)
    assert store.create_job(job(store, "others"), 10, quota)[1]
    store.create_field(field(store, mine[0]), quota)
    with pytest.raises(QuotaError, match="QUOTA_STORED_BYTES"):
        store.create_field(replace(field(store, mine[1]), bytes=16), quota)
    store.create_field(replace(field(store, mine[1]), bytes=15), quota)
    with pytest.raises(QuotaError, match="QUOTA_FIELDS"):
        store.create_field(replace(field(store, mine[2]), bytes=0), quota)
    assert store.stored("alice") == (2, 25)
    assert store.create_field(field(store, mine[0]), quota)[1] is False
    store.update_field(mine[0], state="rejected")
    assert store.stored("alice") == (1, 15)
    assert store.create_field(field(store, mine[0]), quota)[1], "tried anew"
    store.delete_field(mine[1])
    assert store.stored("alice") == (1, 10)
    assert store.stored("anonymous") == (0, 0)
