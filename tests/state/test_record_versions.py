"""Records of other releases, and damaged ones: docs/adr/0010-versioned-records.md."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from redis import Redis

from regnf_state.journal.journaled_records import JournaledRecordStore
from regnf_state.manifest import read_manifest
from regnf_state.redis.jobs import RecordStore
from regnf_state.redis.webhook_outbox import RedisOutbox
from tests.state.captured import put_back
from tests.state.journal_world import World, fresh_world
from tests.state.record_makers import change, job, started
from tests.stores import HeldBlobs

_YEARS = 50 * 365 * 24 * 3600


@pytest.fixture
def world(any_redis: Redis, tmp_path: Path) -> World:
    return fresh_world(any_redis, tmp_path)


@pytest.fixture
def upgraded(any_redis: Redis, tmp_path: Path) -> World:
    """This release over what the one before it has left."""
    blobs = HeldBlobs(tmp_path)
    put_back(any_redis, blobs)
    made = World(any_redis, blobs)
    made.records = JournaledRecordStore(any_redis, _YEARS, blobs)
    return made


# records of the release before


def test_every_record_of_the_release_before_is_read(upgraded: World) -> None:
    states = {job.id: job.status for job in upgraded.records.list_jobs(None, 100, None).records}
    assert states == {
        "accepted": "accepted",
        "of-lab": "accepted",
        "running": "running",
        "requeued": "accepted",
        "successful": "successful",
        "failed": "failed",
        "dismissed": "dismissed",
    }
    fields = {field.label: field.state for field in upgraded.records.list_fields(None, 100, None).records}
    assert fields == {"ready": "ready", "of_lab": "ready", "validating": "validating", "rejected": "rejected"}
    assert len(upgraded.records.events("running", None)) == 3
    manifest = read_manifest(upgraded.blobs, "successful")
    assert manifest is not None
    assert [one.name for one in manifest.artifacts] == ["result.json"]
    outbox = RedisOutbox(upgraded.redis)
    assert [one.state for one in outbox.deliveries(upgraded.job("successful"))] == ["pending"]
    assert upgraded.records.unreadable.total() == 0


def test_what_the_release_before_began_is_ended(upgraded: World) -> None:
    assert upgraded.records.heartbeat("running", 1).status == "running"
    assert upgraded.end("successful", "running").status == "successful"
    upgraded.run("accepted")
    assert upgraded.end("failed", "accepted").status == "failed"
    assert upgraded.records.request_cancel("of-lab").status == "dismissed"  # type: ignore[union-attr]


def test_the_journal_of_the_release_before_is_read(upgraded: World) -> None:
    before = {job.id: job.status for job in upgraded.records.list_jobs(None, 100, None).records}
    upgraded.redis.flushall()
    upgraded.rebuilder = type(upgraded.rebuilder)(upgraded.records, upgraded.queue, upgraded.blobs)
    upgraded.rebuilder.run_if_needed()
    after = {job.id: job.status for job in upgraded.records.list_jobs(None, 100, None).records}
    assert after == before | {"running": "accepted"}


# members of a later release


def test_members_that_are_not_known_are_written_back(store: RecordStore, redis: Redis) -> None:
    started(store)
    change(redis, "regnf:job:j1", budget={"seconds": 12.5}, note=None)
    redis.hset("regnf:job:j1", "extra", "of another release")
    store.heartbeat("j1", 1)
    store.requeue_job("j1", 1)
    store.request_cancel("j1")
    store.create_job(job(store), 10)
    document = json.loads(redis.hget("regnf:job:j1", "document"))  # type: ignore[arg-type]
    assert (document["budget"], document["note"], document["attempt"]) == ({"seconds": 12.5}, None, 3)
    assert redis.hget("regnf:job:j1", "extra") == b"of another release"
    assert [one.id for one in store.list_jobs(None, 10, None).records] == ["j1"]


def test_members_that_are_not_known_survive_in_the_journal(world: World) -> None:
    world.accept()
    change(world.redis, "regnf:job:j1", budget=3)
    world.run()
    world.end("successful")
    world.lose_redis()
    assert world.job().unknown_members == {"budget": 3}


def test_members_that_are_missing_have_their_defaults(store: RecordStore, redis: Redis) -> None:
    started(store)
    document = json.loads(redis.hget("regnf:job:j1", "document"))  # type: ignore[arg-type]
    for member in ("verdict", "more_webhooks", "phase_since", "requeues"):
        del document[member]
    redis.hset("regnf:job:j1", "document", json.dumps(document))
    assert store.update_job("j1", 1, status="successful").status == "successful"
