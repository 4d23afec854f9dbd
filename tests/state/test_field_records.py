"""Fields' records, owners and quotas, kept alike by the store in memory and the one in Redis."""

from dataclasses import replace

import pytest

from regnf_state.ownership import reference_of
from regnf_state.records import Quota, QuotaError, StaleAttemptError
from regnf_state.redis.client import connect
from regnf_state.redis.jobs import RecordStore
from tests.state.record_makers import OBJECT, SCENE, field, job, started

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
    store.update_field(SCENE, attempt=1, state="rejected", error={"reason": "FIELD_NOT_RECOGNIZED"})
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
    assert [record.sha256[0] for record in store.list_fields(None, 10, None).records] == ["2", "1", "0"]
    assert [record.sha256[0] for record in store.list_fields("chair", 1, None).records] == ["2"]
    assert [record.sha256[0] for record in store.list_fields("chair", 10, (2.0, "2" * 64)).records] == ["0"]
    assert store.delete_field("1" * 64)
    assert not store.delete_field("1" * 64)
    assert len(store.list_fields(None, 10, None).records) == 2
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
    assert store.set_if_absent("key", "first", 60) == "first"
    assert store.set_if_absent("key", "second", 60) == "first"
    assert store.set_if_absent("other", "second", 60) == "second"
    store.probe()


def test_a_script_run_twice_by_a_broken_connection_counts_once(redis_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The client repeats a script when it never saw the answer: the second run must neither fail nor apply again."""
    with connect(redis_url) as redis:
        redis.flushall()
        store = RecordStore(redis)
        store.create_job(job(store), 10)
        script = store._write

        def twice(**arguments: object) -> object:
            script(**arguments)
            return script(**arguments)

        monkeypatch.setattr(store, "_write", twice)
        assert store.update_job("j1", 1, status="running").status == "running"
        assert store.heartbeat("j1", 1).version == 3
        assert len(store.events("j1", None)) == 2


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
    assert [record.sha256 for record in store.list_fields(None, 10, None, "alice").records] == [f"{SCENE}_alice"]
    assert [record.id for record in store.list_jobs(None, 10, None, "bob").records] == ["job-of-bob"]
    assert [record.id for record in store.list_jobs(None, 10, None, "carol").records] == []
    assert len(store.list_fields(None, 10, None).records) == len(store.list_jobs(None, 10, None).records) == 3
    store.update_job("job-of-bob", 1, status="failed", error={"reason": "INTERNAL"})
    store.delete_job("job-of-bob")
    store.delete_field(f"{SCENE}_alice")
    assert store.list_jobs(None, 10, None, "bob").records == store.list_fields(None, 10, None, "alice").records == []


def test_an_expired_job_is_so_to_its_owner_alone(redis_url: str) -> None:
    with connect(redis_url) as redis:
        redis.flushall()
        store = RecordStore(redis, retention_s=0)
        store.create_job(replace(job(store), request={"scene": reference_of("alice", SCENE)}), 10)
        store.update_job("j1", 1, status="failed", error={"reason": "INTERNAL"})
        redis.set("regnf:job:j1:gone", "alice")  # with no retention at all the tombstone would be gone as well
        redis.delete("regnf:job:j1")
        assert store.job_expired("j1", "alice")
        assert not store.job_expired("j1", "bob")
        assert not store.job_expired("j1")
        assert store.expire_jobs() == ["j1"]
        assert store.list_jobs(None, 10, None, "alice").records == []
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
    with pytest.raises(QuotaError, match="QUOTA_STORED"):
        store.create_field(replace(field(store, mine[1]), bytes=16), quota)
    store.create_field(replace(field(store, mine[1]), bytes=15), quota)
    with pytest.raises(QuotaError, match="QUOTA_STORED"):
        store.create_field(replace(field(store, mine[2]), bytes=0), quota)
    assert store.stored("alice") == (2, 25)
    assert store.create_field(field(store, mine[0]), quota)[1] is False
    store.update_field(mine[0], state="rejected")
    assert store.stored("alice") == (1, 15)
    assert store.create_field(field(store, mine[0]), quota)[1], "tried anew"
    store.delete_field(mine[1])
    assert store.stored("alice") == (1, 10)
    assert store.stored("anonymous") == (0, 0)


def test_what_an_import_made_counts_towards_the_quota(store: RecordStore) -> None:
    quota = Quota(stored_bytes=100)
    large, small, other = (reference_of("alice", digit * 64) for digit in "123")
    store.create_field(replace(field(store, large), bytes=10), quota)
    store.create_field(replace(field(store, small), bytes=20), quota)
    assert store.stored("alice") == (2, 30), "nothing is made yet"
    store.update_field(small, attempt=1, state="ready", report={"field_bytes": 5})
    store.update_field(large, attempt=1, state="ready", report={"field_bytes": 81})
    assert store.stored("alice") == (2, 101), "the one that went over stays"
    with pytest.raises(QuotaError, match="QUOTA_STORED"):
        store.create_field(replace(field(store, other), bytes=1), quota)
    store.update_field(large, label="hall")
    assert store.stored("alice") == (2, 101)
    lost = store.get_field(large)
    assert lost is not None
    store.delete_field(large)
    assert store.stored("alice") == (1, 20)
    assert store.restore_field(lost)
    assert store.stored("alice") == (2, 101)


def test_several_fields_come_in_the_order_asked_for(store: RecordStore) -> None:
    store.create_field(field(store, SCENE))
    store.create_field(field(store, OBJECT))
    found = store.get_fields([OBJECT, "c" * 64, SCENE])
    assert found == [store.get_field(OBJECT), None, store.get_field(SCENE)]
