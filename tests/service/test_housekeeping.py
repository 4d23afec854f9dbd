"""What goes from the store because nobody needs it, and what stays because somebody does."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest
from redis import Redis

from regnf_service.upkeep.housekeeping import Housekeeper, Lease, LeaseLostError
from regnf_state.records import FieldRecord, JobRecord
from regnf_state.settings import Settings
from tests.stores import stores_over

DAY_S = 24 * 3600.0


@dataclass
class World:
    redis: Redis
    folder: Path
    settings: Settings = field(default_factory=Settings)

    def __post_init__(self) -> None:
        stores = stores_over(self.redis, self.folder)
        self.records, self.blobs = stores.records, stores.blobs
        self.lease = Lease(self.redis, "lease", 30.0)

    def add_field(self, letter: str, size: int = 100, state: str = "ready") -> str:
        now = self.records.now()
        sha256 = letter * 64
        self.records.create_field(FieldRecord(sha256, "validating", size, now, now))
        self.blobs.put(f"fields/{sha256}/field.safetensors", bytes(size))
        self.records.update_field(sha256, state=state)
        return sha256

    def add_job(self, job_id: str, scene: str, object_: str, size: int = 0, ended: bool = True) -> None:
        now = self.records.now()
        request = {"scene": scene, "object": object_}
        self.records.create_job(JobRecord(job_id, "registration", "accepted", request, {}, now, now), 100)
        if ended:
            self.records.update_job(job_id, 1, status="running")
            self.blobs.put(f"jobs/{job_id}/1/result.json", bytes(size))
            self.records.update_job(job_id, 1, status="successful")

    def tidy(self, later_s: float = 0.0, **settings: object) -> dict[str, list[str]]:
        self.records.ahead_s += later_s
        keeper = Housekeeper(self.records, self.blobs, self.redis, self.settings.model_copy(update=settings))
        with self.lease.held() as term:
            assert term is not None
            return keeper.run(term)

    def fields(self) -> set[str]:
        return {key.split("/")[1][0] for key in self.blobs.list("fields")}


@pytest.fixture
def world(redis: Redis, tmp_path: Path) -> World:
    redis.flushall()
    return World(redis, tmp_path)


def test_by_default_fields_stay(world: World) -> None:
    world.add_field("a")
    assert world.tidy(1000 * DAY_S) == {}
    assert world.fields() == {"a"}


def test_a_field_goes_once_nobody_has_used_it_for_long(world: World) -> None:
    keep = {"field_retention_s": 10 * DAY_S}
    a, b, c = (world.add_field(letter) for letter in "abc")
    assert world.tidy(**keep) == {}, "from now on they count as unused"
    world.records.ahead_s += 8 * DAY_S
    world.add_job("j", a, b)
    assert world.tidy(3 * DAY_S, **keep) == {"fields": [c]}
    assert world.records.get_field(c) is None
    assert world.fields() == {"a", "b"}
    assert sorted(world.tidy(8 * DAY_S, **keep)["fields"]) == [a, b]
    assert list(world.records.journal.fields()) == []


def test_what_a_live_job_needs_stays(world: World) -> None:
    a, b = world.add_field("a"), world.add_field("b")
    world.tidy()
    world.add_job("j", a, b, ended=False)
    assert world.tidy(100 * DAY_S, field_retention_s=60, max_stored_bytes=1) == {}
    assert world.fields() == {"a", "b"}


def test_a_field_that_is_asked_for_while_it_goes_comes_back(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    a = world.add_field("a")
    world.tidy()
    known = world.records.get_field(a)
    delete: Callable[[str], bool] = world.records.delete_field

    def and_somebody_asks(sha256: str) -> bool:
        world.add_job("j", sha256, sha256, ended=False)
        return delete(sha256)

    monkeypatch.setattr(world.records, "delete_field", and_somebody_asks)
    assert world.tidy(100 * DAY_S, field_retention_s=60) == {}
    assert world.records.get_field(a) == known
    assert world.records.journal.recall_field(a) == replace(known, version=1) if known else None
    assert world.fields() == {"a"}


def test_rejected_fields_are_forgotten_after_a_while(world: World) -> None:
    a = world.add_field("a", state="rejected")
    assert world.tidy(6 * DAY_S) == {}
    assert world.tidy(2 * DAY_S) == {"fields": [a]}


def test_beyond_the_cap_the_oldest_go_and_the_youngest_stay(world: World) -> None:
    a, b = world.add_field("a", 100_000), world.add_field("b", 100_000)
    world.add_job("old", a, a, size=300_000)
    world.tidy()
    world.records.ahead_s += DAY_S / 2
    world.add_job("new", b, b, size=300_000)
    world.records.ahead_s += DAY_S / 2
    removed = world.tidy(max_stored_bytes=450_000)
    assert removed == {"jobs": ["old"], "fields": [a]}
    assert world.records.get_job("old") is None
    assert sum(map(len, (data for key, data in world.blobs.blobs.items() if not key.startswith("journal/")))) == 400_000
    world.add_job("fresh", b, b, size=300_000)
    assert world.tidy(60.0, max_stored_bytes=1)["jobs"] == ["new"], "what is an hour old at most is not taken"


def test_folders_that_no_record_knows_go_after_a_day(world: World) -> None:
    a = world.add_field("a")
    world.add_job("j", a, a, size=10)
    world.blobs.put("jobs/unknown/1/result.json", b".")
    world.blobs.put(f"fields/{'c' * 64}/original", b".")
    world.blobs.age()
    assert set(world.tidy()["orphans"]) == {"jobs/unknown", f"fields/{'c' * 64}"}
    assert world.fields() == {"a"}
    assert list(world.blobs.list("jobs")) == ["jobs/j/1/result.json"]


def test_the_journal_of_a_job_whose_record_has_expired_goes_too(world: World) -> None:
    """Its record went, and whoever saw to that died before the rest was done."""
    a = world.add_field("a")
    for job_id in ("dead", "alive"):
        world.add_job(job_id, a, a, size=10)
    world.redis.delete("regnf:job:dead")
    world.tidy()
    assert list(world.records.journal.jobs()) == ["alive", "dead"], "not before its time"
    world.tidy(8 * DAY_S)
    assert list(world.records.journal.jobs()) == ["alive"]
    assert list(world.blobs.list("jobs")) == ["jobs/alive/1/result.json"]


def test_nothing_goes_while_redis_has_lost_the_records(world: World) -> None:
    world.add_job("j", world.add_field("a"), world.add_field("b"), size=10)
    before = dict(world.blobs.blobs)
    world.redis.flushall()
    assert world.tidy(100 * DAY_S, field_retention_s=60, max_stored_bytes=1) == {}
    assert world.blobs.blobs == before


def test_a_leader_that_no_longer_leads_deletes_nothing(world: World) -> None:
    a = world.add_field("a")
    world.tidy()
    world.records.ahead_s += 100 * DAY_S
    keeper = Housekeeper(
        world.records, world.blobs, world.redis, world.settings.model_copy(update={"field_retention_s": 60})
    )
    with world.lease.held() as term:
        assert term is not None
        world.redis.delete("lease")
        with pytest.raises(LeaseLostError):
            keeper.run(term)
    assert world.records.get_field(a) is not None


def test_once_an_hour_is_enough(world: World) -> None:
    world.blobs.put("jobs/unknown/1/result.json", b".")
    world.blobs.age()
    keeper = Housekeeper(world.records, world.blobs, world.redis, world.settings)
    with world.lease.held() as term:
        assert term is not None
        assert keeper.run_if_due(term)["orphans"] == ["jobs/unknown"]
        world.blobs.put("jobs/unknown/1/result.json", b".")
        world.blobs.age()
        assert keeper.run_if_due(term) == {}


def test_a_batch_goes_when_its_time_is_over(world: World) -> None:
    world.blobs.put("batches/anyone/old", b"{}")
    world.tidy()
    assert list(world.blobs.list("batches")) == ["batches/anyone/old"]
    world.blobs.age()
    world.blobs.put("batches/anyone/new", b"{}")
    world.tidy()
    assert list(world.blobs.list("batches")) == ["batches/anyone/new"]


def test_pieces_and_journals_count_in_the_cap(world: World) -> None:
    a = world.add_field("a", 10_000)
    world.add_job("j", a, a, size=10_000)
    pieces = [f"uploads/anyone/{letter * 64}/{0:015d}-20000" for letter in "bc"]
    for number, key in enumerate(pieces):
        world.blobs.put(key, bytes(10_000))
        moment = world.records.now() - (3 - number) * DAY_S
        os.utime(world.blobs.path_of(key), (moment, moment))
    journal = sum(entry.bytes for entry in world.blobs.entries("journal"))
    kept = {"keep_pieces_s": 100 * int(DAY_S)}
    assert world.tidy(max_stored_bytes=40_000 + journal, **kept) == {}
    assert list(world.blobs.list("uploads")) == pieces
    world.tidy(max_stored_bytes=40_000 + journal - 1, **kept)
    assert list(world.blobs.list("uploads")) == pieces[1:]
    world.tidy(max_stored_bytes=20_000 + journal, **kept)
    assert list(world.blobs.list("uploads")) == []
    assert world.records.get_job("j") is not None, "it is younger than an hour"


def test_batches_count_in_the_cap_and_go_before_their_time(world: World) -> None:
    for number in range(3):
        world.blobs.put(f"batches/anyone/{number}", b"." * 600)
        moment = world.records.now() - (3 - number) * DAY_S
        os.utime(world.blobs.path_of(f"batches/anyone/{number}"), (moment, moment))
    world.tidy(max_stored_bytes=1000)
    assert list(world.blobs.list("batches")) == ["batches/anyone/2"]


# one leader at a time, and a leader that was slow hears that it no longer leads


@pytest.fixture
def lease(redis: Redis) -> Lease:
    redis.flushall()
    return Lease(redis, "lease", 30.0)


def test_one_leader_at_a_time(lease: Lease) -> None:
    with lease.held() as first, lease.held() as second:
        assert first is not None
        assert second is None
        first.confirm()
    with lease.held() as third:
        assert third is not None
        assert third.number > first.number


def test_a_leader_whose_term_has_lapsed_is_told(lease: Lease, redis: Redis) -> None:
    with lease.held() as slow:
        assert slow is not None
        redis.delete("lease")
        with lease.held() as next_:
            assert next_ is not None
            with pytest.raises(LeaseLostError):
                slow.confirm()
            next_.confirm()
    assert not redis.exists("lease")


def test_the_end_of_an_old_term_does_not_end_the_new_one(lease: Lease, redis: Redis) -> None:
    with lease.held():
        redis.set("lease", "999")
    assert redis.get("lease") == b"999"


def test_a_confirmed_term_goes_on(lease: Lease, redis: Redis) -> None:
    with lease.held() as term:
        assert term is not None
        redis.pexpire("lease", 1000)
        term.confirm()
        left = redis.pttl("lease")
        assert isinstance(left, int)
        assert left > 20_000
