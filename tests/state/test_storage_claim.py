"""One Redis belongs to one storage."""

from __future__ import annotations

from pathlib import Path

import pytest
from redis import Redis

from regnf_state.journal.journal import STORAGE_KEY, StorageMismatchError, claim_storage
from tests.state.journal_world import World, fresh_world
from tests.stores import HeldBlobs


def test_an_empty_redis_takes_the_first_storage(redis: Redis) -> None:
    claim_storage(redis, "a")
    claim_storage(redis, "a")
    with pytest.raises(StorageMismatchError, match="REGNF_ADOPT_STORAGE=b") as caught:
        claim_storage(redis, "b")
    assert caught.value.reason == "STORAGE_MISMATCH"
    assert redis.get(STORAGE_KEY) == b"a"
    redis.flushall()
    claim_storage(redis, "b")


def test_the_operator_states_a_change(redis: Redis) -> None:
    claim_storage(redis, "a")
    with pytest.raises(StorageMismatchError):
        claim_storage(redis, "b", adopt="c")
    claim_storage(redis, "b", adopt="b")
    claim_storage(redis, "b")
    with pytest.raises(StorageMismatchError):
        claim_storage(redis, "a")


def test_records_are_not_made_anew_in_another_s_redis(any_redis: Redis, tmp_path: Path) -> None:
    """Else both services would take each other's jobs."""
    first = fresh_world(any_redis, tmp_path / "first")
    first.accept("j1")
    second = World(any_redis, HeldBlobs(tmp_path / "second"))
    with pytest.raises(StorageMismatchError):
        second.rebuilder.run_if_needed()
    assert first.rebuilder.run_if_needed().jobs == ()
    assert first.job("j1").status == "accepted"


def test_a_redis_that_was_emptied_is_taken_by_its_storage_again(any_redis: Redis, tmp_path: Path) -> None:
    world = fresh_world(any_redis, tmp_path)
    world.accept("j1")
    assert world.lose_redis().jobs == ("j1",)
    assert any_redis.get(STORAGE_KEY) == world.records.journal.storage_id().encode()
