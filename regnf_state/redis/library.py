"""Callers' libraries in Redis: entries are parts of field records, found by name and listed by time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from regnf_core.library_entries import EntryNotes
from regnf_state.library import LibraryEntry, NameTakenError, recorded
from regnf_state.pages import Page, Position
from regnf_state.records import FieldRecord, StaleAttemptError
from regnf_state.redis.documents import Cap, Command, text
from regnf_state.redis.fields import FIELD, RedisFieldRecords
from regnf_state.redis.library_index import listed_key, name_key, unlisted


class RedisLibrary(RedisFieldRecords):
    """The part of the record store that is about libraries."""

    def set_entry(self, known: FieldRecord, notes: EntryNotes | None) -> FieldRecord:
        while True:
            field, now = self._current_field(known.sha256)
            if field.library != known.library:
                raise StaleAttemptError("the entry has changed")
            added = field.library["added"] if field.library is not None else now
            said = None if notes is None else recorded(notes, added)
            changed = replace(field, version=field.version + 1, updated=now, library=said)
            answer = self._save_field(field.version, changed, *_renaming(field, notes))
            if answer == "OK":
                return changed
            taken = notes is not None and answer == NameTakenError.reason
            if notes is not None and taken and self.entries_named(known.owner, [notes.name])[0] is not None:
                raise NameTakenError(notes.name)

    def entries_named(self, owner: str, names: Sequence[str]) -> list[LibraryEntry | None]:
        keys = [name_key(owner, name) for name in names]
        references: list[Any] = self._redis.mget(keys) if keys else []
        held = {key: text(reference) for key, reference in zip(keys, references, strict=True) if reference is not None}
        fields = dict(zip(held, self._read_each(FIELD, list(held.values())), strict=True))
        found: list[LibraryEntry | None] = []
        for name, key in zip(names, keys, strict=True):
            field = fields.get(key)
            entry = None if field is None else LibraryEntry.of(field)
            if key in held and (entry is None or entry.notes.name != name):
                self._redis.delete(key)  # an earlier release, or damage, has taken the entry away
                entry = None
            found.append(entry)
        return found

    def list_entries(
        self, owner: str, tag: str | None, part: str | None, limit: int, before: Position | None
    ) -> Page[FieldRecord]:
        def wanted(field: FieldRecord) -> bool:
            said = field.library
            if said is None or (tag is not None and tag not in said["tags"]):
                return False
            return part is None or part.casefold() in said["name"].casefold()

        return self._page(listed_key(owner), FIELD, limit, before, wanted)


def _renaming(field: FieldRecord, notes: EntryNotes | None) -> tuple[list[Command], list[Cap]]:
    """What gives the old name free, and what asks that the new one is nobody's yet."""
    if field.library is not None and notes is not None and field.library["name"] == notes.name:
        return [], []
    taken: list[Cap] = []
    if notes is not None:
        taken = [("EXISTS", name_key(field.owner, notes.name), 1, 1, NameTakenError.reason)]
    return unlisted(field)[:1], taken
