"""Entries of libraries: parts of field records, found by name, listed by time, and kept in the journal."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from redis import Redis

from regnf_core.errors import InvalidInputError
from regnf_core.library_entries import EntryNotes, checked_symmetry
from regnf_state.ownership import reference_of
from regnf_state.record_store import NameTakenError
from regnf_state.records import FieldRecord, StaleAttemptError, UnreadableRecordError
from regnf_state.redis.jobs import RecordStore
from tests.state.journal_world import World, fresh_world
from tests.state.record_makers import OBJECT, SCENE, change, field

CHAIR = EntryNotes.checked("chair", ["seat"], "cm", "of the hall", {"order": 4, "axis": [0, 0, 3], "continuous": False})


@pytest.fixture
def world(any_redis: Redis, tmp_path: Path) -> World:
    return fresh_world(any_redis, tmp_path)


def ready(store: RecordStore, reference: str = SCENE) -> FieldRecord:
    store.create_field(field(store, reference))
    return store.update_field(reference, state="ready")


def names(store: RecordStore, owner: str = "anonymous", **chosen: Any) -> list[str]:
    page = store.list_entries(owner, chosen.get("tag"), chosen.get("part"), 10, None)
    return [(found.library or {})["name"] for found in page.records]


def named(store: RecordStore, name: str, owner: str = "anonymous") -> str | None:
    (entry,) = store.entries_named(owner, [name])
    return None if entry is None else entry.field.sha256


def test_an_entry_comes_changes_and_goes(store: RecordStore) -> None:
    known = store.set_entry(ready(store), CHAIR)
    assert (named(store, "chair"), names(store), names(store, tag="seat"), names(store, part="HAI")) == (
        SCENE,
        ["chair"],
        ["chair"],
        ["chair"],
    )
    assert names(store, tag="table") == names(store, part="table") == names(store, owner="lab") == []
    (entry,) = store.entries_named("anonymous", ["chair"])
    assert entry is not None
    assert (entry.notes, entry.symmetry) == (CHAIR, {"order": 4, "axis": [0.0, 0.0, 1.0], "continuous": False})
    known = store.set_entry(known, EntryNotes.checked("stool"))
    assert (named(store, "chair"), named(store, "stool"), names(store)) == (None, SCENE, ["stool"])
    known = store.set_entry(known, None)
    assert (named(store, "stool"), names(store), known.library) == (None, [], None)


def test_a_name_is_taken_by_one(store: RecordStore) -> None:
    first, second = ready(store), ready(store, OBJECT)
    store.set_entry(first, CHAIR)
    with pytest.raises(NameTakenError):
        store.set_entry(second, CHAIR)
    other = ready(store, reference_of("lab", SCENE))
    store.set_entry(other, CHAIR)
    assert (named(store, "chair"), named(store, "chair", "lab")) == (SCENE, reference_of("lab", SCENE))


def test_of_two_changes_the_second_is_refused(store: RecordStore) -> None:
    known = store.set_entry(ready(store), CHAIR)
    store.set_entry(known, EntryNotes.checked("stool"))
    with pytest.raises(StaleAttemptError):
        store.set_entry(known, None)
    assert names(store) == ["stool"]


def test_the_entry_outlives_imports_and_goes_with_its_field(store: RecordStore) -> None:
    known = store.set_entry(ready(store), CHAIR)
    store.reimport_field(known, {"sign": -1}, None)
    store.update_field(SCENE, state="rejected", error={"reason": "FIELD_SHAPES_MISMATCH"})
    again, created = store.create_field(field(store))
    assert (created, (again.library or {})["name"], named(store, "chair")) == (True, "chair", SCENE)
    assert store.delete_field(SCENE)
    assert (named(store, "chair"), names(store)) == (None, [])
    store.set_entry(ready(store, OBJECT), CHAIR)


def test_a_name_whose_entry_was_lost_is_free_again(store: RecordStore, redis: Redis) -> None:
    """An earlier release deletes a field, and does not know of names."""
    store.set_entry(ready(store), CHAIR)
    redis.delete(f"regnf:field:{SCENE}")
    assert named(store, "chair") is None
    store.set_entry(ready(store, OBJECT), CHAIR)
    assert (named(store, "chair"), names(store)) == (OBJECT, ["chair"])


@pytest.mark.parametrize("said", [{"name": 3}, {"name": "a", "tags": "b", "added": 1}, {"name": "a", "tags": []}])
def test_a_damaged_entry_is_noticed(store: RecordStore, redis: Redis, said: dict[str, Any]) -> None:
    ready(store)
    change(redis, f"regnf:field:{SCENE}", library=said)
    with pytest.raises(UnreadableRecordError, match="library"):
        store.get_field(SCENE)


def test_entries_are_rebuilt_with_their_fields(world: World) -> None:
    world.field()
    world.records.set_entry(world.known_field(), CHAIR)
    world.lose_redis()
    assert named(world.records, "chair") == "a" * 64
    assert names(world.records) == ["chair"]


@pytest.mark.parametrize(
    "said",
    [3, {}, {"order": True, "axis": None, "continuous": False}, {"order": 2, "axis": [1, 2], "continuous": False}],
)
def test_no_symmetry(said: Any) -> None:
    with pytest.raises(InvalidInputError) as caught:
        checked_symmetry(said)
    assert caught.value.reason == "LIBRARY_ENTRY_INVALID"
