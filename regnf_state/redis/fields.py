"""Field records in Redis."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from redis import Redis

from regnf_core import __version__
from regnf_core.importing.gate.report import OF_THE_FILE
from regnf_core.library_entries import EntryNotes
from regnf_core.version import ENGINE_REVISION
from regnf_state import transitions
from regnf_state.ownership import owner_of
from regnf_state.record_store import LibraryEntry, NameTakenError, Page, Position, recorded
from regnf_state.records import NO_QUOTA, FieldRecord, Quota, QuotaError, StaleAttemptError, UnreadableRecordError
from regnf_state.redis import counters
from regnf_state.redis.counters import OWNERS, Owners
from regnf_state.redis.documents import Cap, Command, Kind, RedisDocuments, owned_key, text
from regnf_state.redis.unreadable import PREFIX, Stored

# Where the entries of callers' libraries are listed in Redis.
#
# Keys:  regnf:owner:{owner}:library                sorted by time: references of the fields that are entries
#        regnf:owner:{owner}:library:{sha256}       the reference of the field whose entry has the name with this
#   digest


def name_key(owner: str, name: str) -> str:
    """Which field of an owner has an entry of this name."""
    return f"{owned_key(owner, 'library')}:{hashlib.sha256(name.encode()).hexdigest()}"


def _by_time(key: str, name: str, time: float | None) -> Command:
    """What lists a name by time in a sorted set; None: what takes it out."""
    return ("ZREM", key, name) if time is None else ("ZADD", key, repr(time), name)


def listed(record: FieldRecord) -> list[Command]:
    """What lists the entry of a field, if it has one."""
    entries = owned_key(record.owner, "library")
    if record.library is None:
        return [_by_time(entries, record.sha256, None)]
    named: Command = ("SET", name_key(record.owner, record.library["name"]), record.sha256)
    return [named, _by_time(entries, record.sha256, float(record.library["added"]))]


def unlisted(record: FieldRecord) -> list[Command]:
    """What takes the entry of a field out of the lists."""
    if record.library is None:
        return []
    return [
        ("DEL", name_key(record.owner, record.library["name"])),
        ("ZREM", owned_key(record.owner, "library"), record.sha256),
    ]


# Why an owner's uploads were rejected, kept after their fields are gone: the same bytes are not imported again for
# it.
#
# Kept is what follows from the bytes, their description and the version of the importer. What a limit, a setting or the
# machine had its part in (load, memory, storage, a worker's death) may end otherwise next time: it is never kept.
# Each owner has rejections of its own. Those of others would tell it, by how soon the answer comes, what others have
# sent.

_KEPT_S = 24 * 3600
_MOST = 256
_PUT = """
redis.call('SET', KEYS[2], ARGV[1], 'EX', ARGV[2])
redis.call('ZADD', KEYS[1], ARGV[3], KEYS[2])
redis.call('EXPIRE', KEYS[1], ARGV[2])
for _, key in ipairs(redis.call('ZRANGE', KEYS[1], 0, -1 - tonumber(ARGV[4]))) do
  redis.call('DEL', key)
  redis.call('ZREM', KEYS[1], key)
end
"""


def _key(field: FieldRecord) -> str:
    asked = json.dumps([field.sha256, field.description, __version__, ENGINE_REVISION], sort_keys=True)
    return f"{PREFIX}rejection:{hashlib.sha256(asked.encode()).hexdigest()}"


class RedisRejections(RedisDocuments):
    """The part of the record store that is about rejections. Each owner's oldest go first."""

    def remember_rejection(self, field: FieldRecord, error: dict[str, Any]) -> None:
        """Keep why this upload was rejected, if that lies in the file."""
        if error.get("reason") not in OF_THE_FILE:
            return
        keys = [owned_key(field.owner, "rejections"), _key(field)]
        self._redis.eval(_PUT, 2, *keys, json.dumps(error), _KEPT_S, repr(self.now()), _MOST)

    def known_rejection(self, field: FieldRecord) -> dict[str, Any] | None:
        """Why the same upload was rejected lately."""
        held: Any = self._redis.get(_key(field))
        return None if held is None else json.loads(held)


_CREATED = f"{PREFIX}fields:created"
_VALIDATING = f"{PREFIX}fields:validating"
_UNDRAWN = f"{PREFIX}fields:undrawn"
"""Ready fields whose mesh and picture are to be made, by the time they were requested."""
_ATTEMPTS_KEPT_S = str(48 * 3600)
"""How long a deleted field's count of attempts is kept: longer than anything else that names them."""
_LOOKED_AT = 256
"""Of an owner's kept uploads at once; there are hardly more."""


FIELD = Kind("field", FieldRecord)


def _created_keys(reference: str) -> tuple[str, str]:
    return _CREATED, f"{_CREATED}:{owner_of(reference)}"


def _caps(record: FieldRecord, quota: Quota) -> list[Cap]:
    key, caps = owned_key(record.owner, "stored"), list[Cap]()
    if quota.imports is not None:
        caps.append(("SCARD", owned_key(record.owner, "importing"), 1, quota.imports, "QUOTA_ACTIVE_JOBS"))
    if quota.fields is not None:
        caps.append(("HLEN", key, 1, quota.fields, "QUOTA_STORED"))
    if quota.stored_bytes is not None:
        caps.append(("HVALS", key, record.kept_bytes, quota.stored_bytes, "QUOTA_STORED"))
    return caps


class RedisFieldRecords(RedisRejections):
    """The half of the record store that is about fields."""

    def __init__(self, redis: Redis) -> None:
        super().__init__(redis)
        self.owners = Owners(redis)

    def _save_field(
        self, expected_version: int, record: FieldRecord, more: Sequence[Command] = (), caps: Sequence[Cap] = ()
    ) -> str:
        owner, name, is_rejected = record.owner, record.sha256, record.state == "rejected"
        importing = "SADD" if record.state == "validating" else "SREM"
        stored = owned_key(owner, "stored")
        indexes: list[Command] = [
            ("SADD", OWNERS, owner),
            *((importing, each, name) for each in (_VALIDATING, owned_key(owner, "importing"))),
            *(_by_time(each, name, record.created) for each in _created_keys(name)),
            *listed(record),
            *more,
            _by_time(_UNDRAWN, name, record.updated if record.views == "pending" else None),
            _by_time(owned_key(owner, "rejected"), name, record.updated if is_rejected else None),
            _by_time(owned_key(owner, "originals"), name, record.original_until),
            ("HDEL", stored, name)
            if is_rejected and record.original_until is None
            else ("HSET", stored, name, str(record.kept_bytes)),
        ]
        return self._compare_and_set(FIELD.key(record.sha256), expected_version, indexes, record, caps)

    def _change_field(
        self, sha256: str, change: Callable[[FieldRecord, float], FieldRecord], must_last: bool = False
    ) -> FieldRecord:
        while True:
            known, now = self._current_field(sha256)
            changed = change(known, now)
            if self._save_field(known.version, changed, counters.of_field(known, changed)) == "OK":
                self._note_field(changed, must_last)
                return changed

    def _note_field(self, field: FieldRecord, must_last: bool) -> None:
        """A field has changed; ``must_last``: what is said of it must outlast Redis."""

    def _current_field(self, sha256: str) -> tuple[FieldRecord, float]:
        try:
            known, now = self._read(FIELD, sha256)
        except UnreadableRecordError as error:
            raise StaleAttemptError(str(error)) from error
        if known is None:
            raise StaleAttemptError("there is no such field")
        return known, now

    def _heal(self, kind: Kind[Any], name: str, stored: Stored, error: UnreadableRecordError) -> None:
        super()._heal(kind, name, stored, error)
        if kind is FIELD and not error.newer:
            self._redis.srem(_VALIDATING, name)
            self._redis.zrem(_UNDRAWN, name)
            self._redis.hdel(owned_key(owner_of(name), "stored"), name)
            self._redis.zrem(owned_key(owner_of(name), "originals"), name)

    def create_field(self, record: FieldRecord, quota: Quota = NO_QUOTA) -> tuple[FieldRecord, bool]:
        """Store a new field, or return the one that exists (False).

        A rejected field starts again with what ``record`` says, as the next attempt (True): enqueue its import.
        Rejected ones count towards no quota. Raises QuotaError.
        """
        while True:
            known, now = self._read_to_create(FIELD, record.sha256)
            fresh = self._first(record) if known is None else transitions.restarted_field(known, record, now)
            if fresh is None:
                assert known is not None
                return known, False
            answer = self._save_field(known.version if known is not None else 0, fresh, caps=_caps(fresh, quota))
            if answer.startswith("QUOTA"):
                raise QuotaError(answer)
            if answer == "OK":
                return fresh, True

    def _first(self, record: FieldRecord) -> FieldRecord:
        """The new field, its attempts counted on from those at a deleted one: whatever still works at them is stale."""
        before: Any = self._redis.get(f"{FIELD.key(record.sha256)}:attempts")
        return record if before is None else replace(record, attempt=record.attempt + int(before))

    def importing(self, owner: str) -> int:
        """How many of an owner's imports wait or run."""
        return int(self._redis.scard(owned_key(owner, "importing")))

    def stored(self, owner: str) -> tuple[int, int]:
        """How many fields an owner has of which bytes are kept, and these bytes: few of the rejected ones.

        Of a ready field these are the bytes of its upload or of what the import made, whichever are more.
        """
        sizes: Any = self._redis.hvals(owned_key(owner, "stored"))
        return len(sizes), sum(map(int, sizes))

    def restore_field(self, record: FieldRecord) -> bool:
        """Put a record that was lost back as it is; False when the field is known."""
        return self._save_field(0, record) == "OK"

    def get_field(self, sha256: str) -> FieldRecord | None:
        found, _ = self._read(FIELD, sha256)
        if found is None:
            self._require_known(FIELD, sha256)
        return found

    def get_fields(self, references: Sequence[str]) -> list[FieldRecord | None]:
        """Several fields in one round trip, in the order requested."""
        return self._read_each(FIELD, references)

    def list_fields(
        self,
        label: str | None,
        limit: int,
        before: Position | None,
        owner: str | None = None,
        recordings: bool | None = None,
    ) -> Page[FieldRecord]:
        """Newest first, older than ``before`` = (created, reference); ``owner`` None: everybody's. recordings: these
        alone, or all but these."""

        def wanted(record: FieldRecord) -> bool:
            return label in (None, record.label) and recordings in (None, record.is_recording)

        index = _CREATED if owner is None else f"{_CREATED}:{owner}"
        return self._page(index, FIELD, limit, before, wanted)

    def update_field(self, sha256: str, *, attempt: int | None = None, **changes: Any) -> FieldRecord:
        """Compare-and-set. Raises StaleAttemptError for a field that is gone, or past ``attempt`` (None: any).

        ready and rejected are final within an attempt.
        """
        return self._change_field(sha256, lambda known, now: transitions.changed_field(known, attempt, changes, now))

    def validating_fields(self) -> list[FieldRecord]:
        """Every field whose import has not ended."""
        names = sorted(text(name) for name in self._redis.smembers(_VALIDATING))
        return self._read_many(FIELD, names)

    def undrawn_fields(self) -> list[str]:
        """The ready fields whose mesh and picture are to be made, those requested last first."""
        names: Any = self._redis.zrevrange(_UNDRAWN, 0, -1)
        return [text(name) for name in names]

    def draw_next(self, sha256: str) -> None:
        """Note that somebody wants to see a field whose mesh and picture are to be made."""
        self._redis.zadd(_UNDRAWN, {sha256: self.now()}, xx=True)

    def retry_import(self, sha256: str, attempt: int, *, lost: bool = True) -> FieldRecord:
        """Start an import again as the next attempt; ``lost`` as in requeue_job. Raises StaleAttemptError."""
        return self._change_field(sha256, lambda known, now: transitions.retried_field(known, attempt, now, lost))

    def reimport_field(self, known: FieldRecord, description: dict[str, Any], label: str | None) -> FieldRecord:
        """A field whose import has ended, to be imported again as the next attempt, with another description.

        Raises StaleAttemptError when it has changed since it was ``known``.
        """
        return self._change_field(
            known.sha256,
            lambda now_held, now: transitions.reimported_field(now_held, known, description, label, now),
            must_last=True,
        )

    def undo_reimport(self, before: FieldRecord, attempt: int) -> FieldRecord:
        """The field as it was ``before`` that attempt, which has not begun. Raises StaleAttemptError."""
        return self._change_field(
            before.sha256, lambda known, now: transitions.restored_field(known, before, attempt, now), must_last=True
        )

    def fields_with_original(self, owner: str) -> list[FieldRecord]:
        """An owner's fields whose uploads are kept after their import, those whose time is over first, first."""
        names: Any = self._redis.zrange(owned_key(owner, "originals"), 0, _LOOKED_AT - 1)
        return self._read_many(FIELD, [text(name) for name in names])

    def delete_field(self, sha256: str) -> bool:
        while True:
            known, _ = self._read(FIELD, sha256)
            if known is None:
                return False
            commands: list[Command] = [
                ("DEL", FIELD.key(sha256)),
                *(("ZREM", each, sha256) for each in _created_keys(sha256)),
                *(("SREM", each, sha256) for each in (_VALIDATING, owned_key(owner_of(sha256), "importing"))),
                ("ZREM", _UNDRAWN, sha256),
                ("ZREM", owned_key(owner_of(sha256), "rejected"), sha256),
                ("HDEL", owned_key(owner_of(sha256), "stored"), sha256),
                ("ZREM", owned_key(owner_of(sha256), "originals"), sha256),
                *unlisted(known),
                ("SET", f"{FIELD.key(sha256)}:attempts", str(known.attempt), "EX", _ATTEMPTS_KEPT_S),
            ]
            if self._compare_and_set(FIELD.key(sha256), known.version, commands) == "OK":
                self.owners.bound(owner_of(sha256), "deleted", f"{FIELD.key(sha256)}:attempts", int(_ATTEMPTS_KEPT_S))
                return True

    def rejected_beyond(self, owner: str, kept: int, most: int) -> list[str]:
        """An owner's rejected fields beyond so many, the oldest first, ``most`` at most."""
        beyond: Any = self._redis.zrange(owned_key(owner, "rejected"), 0, -kept - 1)
        return [text(name) for name in beyond[:most]]


# Callers' libraries in Redis: entries are parts of field records, found by name and listed by time.


class RedisLibrary(RedisFieldRecords):
    """The part of the record store that is about libraries."""

    def set_entry(self, known: FieldRecord, notes: EntryNotes | None) -> FieldRecord:
        """Make the field an entry of its owner's library, change the entry, or (None) take it out.

        Raises NameTakenError, and StaleAttemptError when the entry is no longer as it was ``known``.
        """
        while True:
            field, now = self._current_field(known.sha256)
            if field.library != known.library:
                raise StaleAttemptError("the entry has changed")
            added = field.library["added"] if field.library is not None else now
            said = None if notes is None else recorded(notes, added)
            changed = replace(field, version=field.version + 1, updated=now, library=said)
            answer = self._save_field(field.version, changed, *_renaming(field, notes))
            if answer == "OK":
                self._note_field(changed, must_last=True)
                return changed
            taken = notes is not None and answer == NameTakenError.reason
            if notes is not None and taken and self.entries_named(known.owner, [notes.name])[0] is not None:
                raise NameTakenError(notes.name)

    def entries_named(self, owner: str, names: Sequence[str]) -> list[LibraryEntry | None]:
        """An owner's entries by their names, in the order requested."""
        keys = [name_key(owner, name) for name in names]
        references: list[Any] = self._redis.mget(keys) if keys else []
        held = {key: text(reference) for key, reference in zip(keys, references, strict=True) if reference is not None}
        fields = dict(zip(held, self._read_each(FIELD, list(held.values())), strict=True))
        found: list[LibraryEntry | None] = []
        for name, key in zip(names, keys, strict=True):
            field = fields.get(key)
            entry = None if field is None else LibraryEntry.of(field)
            if key in held and (entry is None or entry.notes.name != name):
                self._redis.delete(key)  # damage has taken the entry away
                entry = None
            found.append(entry)
        return found

    def list_entries(
        self, owner: str, tag: str | None, part: str | None, limit: int, before: Position | None
    ) -> Page[FieldRecord]:
        """An owner's entries, the one added last first: those with the tag, and with ``part`` in their names."""

        def wanted(field: FieldRecord) -> bool:
            said = field.library
            if said is None or (tag is not None and tag not in said["tags"]):
                return False
            return part is None or part.casefold() in said["name"].casefold()

        return self._page(owned_key(owner, "library"), FIELD, limit, before, wanted)


def _renaming(field: FieldRecord, notes: EntryNotes | None) -> tuple[list[Command], list[Cap]]:
    """What gives the old name free, and what asks that the new one is nobody's yet."""
    if field.library is not None and notes is not None and field.library["name"] == notes.name:
        return [], []
    taken: list[Cap] = []
    if notes is not None:
        taken = [("EXISTS", name_key(field.owner, notes.name), 1, 1, NameTakenError.reason)]
    return unlisted(field)[:1], taken
