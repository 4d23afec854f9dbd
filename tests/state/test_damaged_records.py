"""Damaged records, and those of later formats: set aside, made anew, in nobody's way (docs/adr/0010)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from redis import Redis

from regnf_state.manifest import read_manifest
from regnf_state.records import Quota, UnreadableRecordError
from regnf_state.redis.counters import COUNTERS_KEY, Counters
from regnf_state.redis.jobs import RecordStore
from regnf_state.redis.webhook_outbox import RedisOutbox, due_key, line_of
from tests.state.journal_world import World, fresh_world
from tests.state.record_makers import OBJECT, SCENE, change, field, finished, job, started

_YEARS = 50 * 365 * 24 * 3600


@pytest.fixture
def world(any_redis: Redis, tmp_path: Path) -> World:
    return fresh_world(any_redis, tmp_path)


def _text(text: str) -> Callable[[Redis, str], object]:
    return lambda redis, key: redis.hset(key, "document", text)


def _members(**members: Any) -> Callable[[Redis, str], object]:
    return lambda redis, key: change(redis, key, **members)


def _string(redis: Redis, key: str) -> None:
    redis.delete(key)
    redis.set(key, "a string")


DAMAGES: dict[str, Callable[[Redis, str], object]] = {
    "no JSON": _text("{"),
    "no object": _text("[1]"),
    "nested": _text("[" * 100_000),
    "not a number": _text('{"created": NaN}'),
    "no members": _text("{}"),
    "an unknown status": _members(status="paused"),
    "a text for a number": _members(progress="half"),
    "a time beyond all calendars": _members(updated=1e300),
    "the record of another": _members(id="j2"),
    "another version": _members(version=99),
    "an error with a text for its status": _members(error={"status": "bad"}),
    "a scene that is no text": _members(request={"scene": 5}),
    "a webhook without address": _members(request={"scene": "a" * 64, "webhook": 1}),
    "no text": lambda redis, key: redis.hset(key, "document", b"\xff\xfe"),
    "no document": lambda redis, key: redis.hdel(key, "document"),
    "no version": lambda redis, key: redis.hdel(key, "version"),
    "another type": _string,
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_a_damaged_record_is_set_aside_and_the_others_go_on(
    store: RecordStore, redis: Redis, damage: Callable[[Redis, str], object], caplog: pytest.LogCaptureFixture
) -> None:
    started(store)
    started(store, "j2")
    damage(redis, "regnf:job:j1")
    assert [one.id for one in store.active_jobs()] == ["j2"]
    assert [one.id for one in store.list_jobs(None, 10, None).records] == ["j2"]
    assert [one.record and one.record.id for one in store.news([("j1", None), ("j2", None)])] == [None, "j2"]
    for _ in range(2):
        with pytest.raises(UnreadableRecordError) as caught:
            store.get_job("j1")
        assert caught.value.reason == "RECORD_UNREADABLE"
    assert len([one for one in caplog.messages if "cannot be read" in one]) == 1, "it is said once"
    assert list(Counters(redis).counts("records_unreadable")) == [(("job",), 1.0)]
    assert redis.exists("regnf:quarantine:regnf:job:j1")
    assert 0 < int(redis.ttl("regnf:quarantine:regnf:job:j1")) <= 7 * 24 * 3600  # type: ignore[arg-type]
    store.create_job(job(store), 10)
    assert store.get_job("j1") is not None, "it may be asked for anew"


def test_a_record_of_a_later_format_stays_where_it_is(store: RecordStore, redis: Redis) -> None:
    started(store)
    redis.hset("regnf:job:j1", mapping={"format": "2", "document": "whatever that is"})
    for _ in range(2):
        with pytest.raises(UnreadableRecordError):
            store.get_job("j1")
    with pytest.raises(UnreadableRecordError):
        store.create_job(job(store), 10)
    assert store.list_jobs(None, 10, None).records == []
    assert redis.hget("regnf:job:j1", "document") == b"whatever that is"
    assert store.unreadable.total() == 1


def test_a_damaged_record_is_made_anew_from_the_journal(world: World) -> None:
    world.accept()
    world.run()
    world.accept("j2")
    world.run("j2")
    world.end("successful", "j2")
    world.field()
    for key in ("regnf:job:j1", "regnf:job:j2", f"regnf:field:{'a' * 64}"):
        world.redis.hset(key, "document", "{")
    assert (world.job().status, world.job().attempt) == ("accepted", 2)
    assert world.job("j2").status == "successful"
    assert world.known_field().state == "ready"
    assert {one.id for one in world.records.active_jobs()} == {"j1"}


def test_a_damaged_field_is_set_aside(store: RecordStore, redis: Redis) -> None:
    for name in (SCENE, OBJECT):
        store.create_field(field(store, name))
    redis.hset(f"regnf:field:{SCENE}", "document", "{")
    assert [one.sha256 for one in store.list_fields(None, 10, None).records] == [OBJECT]
    assert [one.sha256 for one in store.validating_fields()] == [OBJECT]
    with pytest.raises(UnreadableRecordError):
        store.get_field(SCENE)
    assert store.stored("anonymous") == (1, 10)
    assert store.create_field(field(store))[1]


def test_those_set_aside_take_no_place_among_an_owner_s_jobs(store: RecordStore, redis: Redis) -> None:
    started(store)
    redis.hset("regnf:job:j1", "document", "{")
    assert store.active_jobs() == []
    assert store.create_job(job(store, "j2"), 1, Quota(active_jobs=1))[1]


def test_a_thousand_are_noted_at_most(store: RecordStore, redis: Redis, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("regnf_state.redis.unreadable._MOST", 3)
    for number in range(5):
        started(store, f"j{number}")
        redis.hset(f"regnf:job:j{number}", "document", "{")
    store.active_jobs()
    assert store.unreadable.total() == 3
    assert len(list(redis.scan_iter("regnf:quarantine:*"))) == 3


@pytest.mark.parametrize("key", ["regnf:job:j1:events", "regnf:jobs:created", "regnf:jobs:expiring"])
def test_an_index_of_another_type_is_begun_anew(store: RecordStore, redis: Redis, key: str) -> None:
    started(store)
    redis.delete(key)
    redis.set(key, "a string")
    assert store.update_job("j1", 1, status="successful").status == "successful"
    assert redis.type(key) in (b"stream", b"zset")


def _another_type(redis: Redis) -> None:
    _string(redis, COUNTERS_KEY)


def _no_numbers(redis: Redis) -> None:
    """Texts, and the greatest of all numbers."""
    held: Any = redis.hgetall(COUNTERS_KEY)
    told = [*held, "records_unreadable|job", "jobs_finished|successful||", "job_run_seconds|successful|sum"]
    redis.hset(COUNTERS_KEY, mapping=dict.fromkeys(told, "x"))
    redis.hset(COUNTERS_KEY, "job_attempts", str(2**63 - 1))


@pytest.mark.parametrize("damage", [_another_type, _no_numbers])
def test_damaged_counters_keep_no_record_from_being_set_aside_or_written(
    store: RecordStore, redis: Redis, damage: Callable[[Redis], None]
) -> None:
    for name in ("j1", "j2"):
        started(store, name)
    redis.hset("regnf:job:j1", "document", "{")
    damage(redis)
    assert list(Counters(redis).counts("records_unreadable")) in ([], [(("job",), 0.0)])
    assert [one.id for one in store.active_jobs()] == ["j2"]
    assert redis.exists("regnf:quarantine:regnf:job:j1")
    assert list(Counters(redis).counts("records_unreadable")) == [(("job",), 1.0)]
    damage(redis)
    assert store.update_job("j2", 1, status="successful").status == "successful"
    assert list(Counters(redis).counts("jobs_finished")) == [(("successful", "", ""), 1.0)]
    damage(redis)
    started(store, "j3")
    assert list(Counters(redis).counts("job_attempts")) == [((), 1.0)]


def test_a_damaged_list_of_the_unreadable_is_begun_anew(store: RecordStore, redis: Redis) -> None:
    started(store)
    redis.hset("regnf:job:j1", "document", "{")
    redis.set("regnf:unreadable", "a string")
    assert store.unreadable.total() == 0
    assert store.active_jobs() == []
    assert store.unreadable.total() == 1
    assert redis.exists("regnf:quarantine:regnf:job:j1")


@pytest.mark.parametrize("held", ["a string", {"a" * 64: "x"}])
def test_what_an_owner_has_counts_as_nothing_where_it_is_damaged(store: RecordStore, redis: Redis, held: Any) -> None:
    for key in ("regnf:owner:anonymous:active", "regnf:owner:anonymous:stored"):
        redis.set(key, held) if isinstance(held, str) else redis.hset(key, mapping=held)
    assert store.create_job(job(store), 10, Quota(active_jobs=1))[1]
    assert store.create_field(field(store), Quota(fields=2, stored_bytes=100))[1]


def test_a_damaged_message_does_not_keep_the_others(store: RecordStore, redis: Redis) -> None:
    line = line_of("anonymous", "https://hooks.example/x")
    redis.zadd(due_key(line), {"nonsense": 1.0, "j1-1-0": 2.0})
    redis.zadd("regnf:webhooks:lines", {line: 0, "anonymous gone.example": 0})
    outbox = RedisOutbox(redis)
    message = outbox.claim()
    assert message is not None
    assert message.job_id == "j1"
    assert redis.zscore(due_key(line), "nonsense") is None
    record = job(store)
    record.request["webhook"] = {"url": "https://hooks.example"}
    redis.hset("regnf:webhook:j1:0", mapping={"message": "j1-1-0", "delivery": "{"})
    assert outbox.deliveries(record)[0].last_error == "RECORD_UNREADABLE"


@pytest.mark.parametrize(
    "text", [b"{", b"[]", b'{"attempt": 1}', b'{"format": 9}', b'{"attempt": 1, "artifacts": [1]}']
)
def test_a_damaged_manifest_has_a_reason(world: World, text: bytes) -> None:
    world.blobs.put("jobs/j1/manifest.json", text)
    with pytest.raises(UnreadableRecordError):
        read_manifest(world.blobs, "j1")


def test_a_damaged_journal_does_not_keep_a_job_from_being_asked_for(world: World) -> None:
    world.blobs.put("journal/jobs/j1/000001-accepted", b"{")
    assert world.accept().status == "accepted"
    world.lose_redis()
    assert world.job().attempt == 2


def test_a_damaged_end_of_a_job_is_no_end(store: RecordStore, redis: Redis) -> None:
    """Expiry goes on past a tombstone that cannot be read."""
    for name in ("j1", "j2"):
        finished(store, "successful", name)
        redis.zadd("regnf:jobs:expiring", {name: 1.0}, xx=True)
    redis.delete("regnf:job:j1:gone")
    redis.sadd("regnf:job:j1:gone", "x")
    assert sorted(store.expire_jobs()) == ["j1", "j2"]
