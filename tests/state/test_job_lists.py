"""Jobs' records: caps, order, events and expiry, kept alike by the store in memory and the one in Redis."""

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
from redis import Redis

from regnf_state.record_store import all_of
from regnf_state.records import QueueFullError, StaleAttemptError
from regnf_state.redis.client import connect
from regnf_state.redis.jobs import RecordStore
from tests.state.record_makers import field, finished, job, started
from tests.stores import expire

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


def test_listing_pages_through_every_job_once(store: RecordStore) -> None:
    times = [5.0, 5.0, 7.0, 5.0, 6.0]
    for number, created in enumerate(times):
        store.create_job(job(store, f"j{number}", created), 10)
    expected = ["j2", "j4", "j3", "j1", "j0"]
    assert [record.id for record in store.list_jobs(None, 10, None).records] == expected
    assert [record.id for record in all_of(lambda rest: store.list_jobs(None, 2, rest))] == expected
    store.update_job("j4", 1, status="running")
    assert [record.id for record in store.list_jobs("running", 10, None).records] == ["j4"]
    assert len(store.list_jobs("accepted", 10, None).records) == 4


def test_long_listings_with_equal_times(store: RecordStore) -> None:
    for number in range(230):
        store.create_field(field(store, f"{number:064d}", created=1.0 if number < 215 else float(number)))
    listed = [record.sha256 for record in all_of(lambda rest: store.list_fields(None, 1000, rest))]
    assert listed == [f"{number:064d}" for number in reversed(range(230))]


@pytest.mark.parametrize("label", ["rare", "never"])
def test_one_page_looks_at_a_bounded_number_of_records(
    store: RecordStore, label: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("regnf_state.redis.documents.LOOKED_AT", 20)
    expected = []
    for number in range(110):
        rare = label == "rare" and number % 7 == 0 and not 30 < number < 90
        record = field(store, f"{number:064d}", created=float(number // 3), label="rare" if rare else "common")
        store.create_field(record)
        if rare:
            expected.insert(0, record.sha256)
    pages = [store.list_fields(label, 2, None)]
    while (rest := pages[-1].rest) is not None:
        pages.append(store.list_fields(label, 2, rest))
    assert [record.sha256 for page in pages for record in page.records] == expected, "each exactly once"
    assert any(not page.records for page in pages), "a page may be empty"
    assert pages[0].rest is not None
    looked_at = [page.rest for page in pages[:-1]]
    assert looked_at == sorted(looked_at, reverse=True)
    assert len(pages) >= 110 / 20, "no page looked further than it may"


def test_records_that_cannot_be_read_are_looked_at_too(store: RecordStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("regnf_state.redis.documents.LOOKED_AT", 3)
    for number in range(9):
        store.create_job(job(store, f"j{number}", float(number)), 10)
    for number in range(2, 8):
        store._redis.hset(f"regnf:job:j{number}", "document", "no record")  # type: ignore[attr-defined]
    assert [record.id for record in store.list_jobs(None, 10, None).records] == ["j8"]
    assert [record.id for record in all_of(lambda rest: store.list_jobs(None, 10, rest))] == ["j8", "j1", "j0"]
    assert store.list_jobs("failed", 1, None).records == []
    assert store.list_jobs("failed", 1, None).rest is not None


# jobs: events


def test_events_tell_every_change_that_shows(store: RecordStore) -> None:
    started(store)
    store.update_job("j1", 1, phase="sampling")
    store.update_job("j1", 1, progress=0.5)
    store.update_job("j1", 1, engine={"version": "1"})
    store.heartbeat("j1", 1)
    store.update_job("j1", 1, status="failed", error={"reason": "NO_SURFACE_IN_OBJECT"})
    events = store.events("j1", None)
    assert [event.name for event in events] == ["status", "status", "progress", "progress", "status"]
    assert [event.data["phase"] for event in events] == [None, "loading", "sampling", "sampling", "sampling"]
    assert events[3].data["progress"] == 0.5
    assert events[-1].data["error"] == {"reason": "NO_SURFACE_IN_OBJECT"}
    assert store.events("j1", events[1].id) == events[2:]
    assert store.events("j1", events[-1].id) == []


def test_news_of_several_jobs(store: RecordStore) -> None:
    started(store)
    last = store.events("j1", None)[-1].id
    store.update_job("j1", 1, progress=0.5)
    new, whole, nobody = store.news([("j1", last), ("j1", None), ("j9", None)])
    assert [event.data["progress"] for event in new.events] == [0.5]
    assert whole.events == store.events("j1", None)
    assert new.record == whole.record == store.get_job("j1")
    assert (nobody.record, nobody.events) == (None, [])


@pytest.mark.parametrize("after", ["", "x", "1-x", "-1", "1-2-3", "9" * 30, "1 ", "²"])
def test_odd_event_ids_are_refused(store: RecordStore, after: str) -> None:
    started(store)
    with pytest.raises(ValueError):
        store.events("j1", after)


# jobs: the end


def test_deleting(store: RecordStore) -> None:
    started(store)
    with pytest.raises(StaleAttemptError):
        store.delete_job("j1")
    store.update_job("j1", 1, status="failed")
    assert store.delete_job("j1")
    assert store.get_job("j1") is None
    assert store.events("j1", None) == []
    assert store.list_jobs(None, 10, None).records == []
    assert not store.job_expired("j1")
    assert store.create_job(job(store), 10)[0].attempt == 1


def test_finished_jobs_expire_and_leave_a_tombstone(redis_url: str) -> None:
    with connect(redis_url) as redis:
        redis.flushall()
        store = RecordStore(redis, retention_s=2)

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
            b"regnf:counters",
            b"regnf:owners",
            b"regnf:jobs:active",
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
    assert [record.id for record in store.list_jobs(None, 10, None).records] == ["waiting"]


def test_an_expired_job_can_be_asked_for_again(redis: Redis) -> None:
    store = RecordStore(redis)
    finished(store, "successful")
    expire(redis, "j1")
    assert store.create_job(job(store), 10)[1]
    assert store.expire_jobs() == []
    assert not store.job_expired("j1")
