"""What the journal remembers of fields, and how their records are made anew from it."""

from dataclasses import replace
from pathlib import Path

import pytest
from redis import Redis

from regnf_state.journal.journaled_records import Rebuilt
from tests.state.journal_world import SCENE, World, fresh_world


@pytest.fixture
def world(redis: Redis, tmp_path: Path) -> World:
    return fresh_world(redis, tmp_path)


def test_a_ready_field_comes_back(world: World) -> None:
    ready = world.field()
    assert world.lose_redis() == Rebuilt(fields=(SCENE,))
    assert replace(world.known_field(), version=ready.version) == ready
    assert world.queue.imports == []


def test_a_field_whose_import_had_not_ended_is_imported(world: World) -> None:
    world.field("validating")
    world.lose_redis()
    assert (world.known_field().state, world.known_field().attempt) == ("validating", 2)
    assert world.queue.imports == [(SCENE, 2)]


def test_a_rejected_field_comes_back_with_its_reason(world: World) -> None:
    world.field("rejected")
    world.lose_redis()
    assert world.known_field().state == "rejected"


def test_a_field_without_its_bytes_does_not_come_back(world: World) -> None:
    world.field()
    world.blobs.delete_prefix(f"fields/{SCENE}")
    assert world.lose_redis() == Rebuilt()
    assert world.records.get_field(SCENE) is None


def test_a_deleted_field_stays_deleted(world: World) -> None:
    world.field()
    world.records.delete_field(SCENE)
    assert world.lose_redis() == Rebuilt()


def test_a_batched_read_recalls_what_redis_lost(world: World) -> None:
    ready = world.field()
    world.redis.flushall()
    found, nobody = world.records.get_fields([SCENE, "d" * 64])
    assert found is not None
    assert replace(found, version=ready.version) == ready
    assert nobody is None
