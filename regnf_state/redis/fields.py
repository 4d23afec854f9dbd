"""Field records in Redis."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from typing import Any

from regnf_state import transitions
from regnf_state.ownership import owner_of
from regnf_state.records import NO_QUOTA, FieldRecord, Quota, QuotaError, StaleAttemptError
from regnf_state.redis import counters
from regnf_state.redis.documents import PREFIX, Cap, Command, RedisDocuments, text

_CREATED = f"{PREFIX}fields:created"
_VALIDATING = f"{PREFIX}fields:validating"
_ATTEMPTS_KEPT_S = str(48 * 3600)
"""How long a deleted field's count of attempts is kept: longer than anything else that names them."""


def _key(sha256: str) -> str:
    return f"{PREFIX}field:{sha256}"


def _created_keys(reference: str) -> tuple[str, str]:
    """Where a field is listed: among all, and among its owner's."""
    return _CREATED, f"{_CREATED}:{owner_of(reference)}"


def _stored_key(owner: str) -> str:
    """The bytes of an owner's uploads by their fields, as long as these are not rejected."""
    return f"{PREFIX}owner:{owner}:stored"


def _caps(record: FieldRecord, quota: Quota) -> list[Cap]:
    key, caps = _stored_key(record.owner), []
    if quota.fields is not None:
        caps.append(("HLEN", key, 1, quota.fields, "QUOTA_FIELDS"))
    if quota.stored_bytes is not None:
        caps.append(("HVALS", key, record.bytes, quota.stored_bytes, "QUOTA_STORED_BYTES"))
    return caps


def _attempts_key(sha256: str) -> str:
    return f"{PREFIX}field:{sha256}:attempts"


class RedisFieldRecords(RedisDocuments):
    """The half of the record store that is about fields."""

    def _save_field(
        self, expected_version: int, record: FieldRecord, more: Sequence[Command] = (), caps: Sequence[Cap] = ()
    ) -> str:
        index: Command = ("SADD" if record.state == "validating" else "SREM", _VALIDATING, record.sha256)
        indexes = [
            index,
            *(("ZADD", each, repr(record.created), record.sha256) for each in _created_keys(record.sha256)),
        ]
        indexes += more
        if record.state == "rejected":
            indexes.append(("HDEL", _stored_key(record.owner), record.sha256))
        else:
            indexes.append(("HSET", _stored_key(record.owner), record.sha256, str(record.bytes)))
        return self._compare_and_set(_key(record.sha256), expected_version, indexes, asdict(record), caps)

    def _change_field(self, sha256: str, change: Callable[[FieldRecord, float], FieldRecord]) -> FieldRecord:
        while True:
            document, now = self._read(_key(sha256))
            if document is None:
                raise StaleAttemptError("there is no such field")
            known = FieldRecord(**document)
            changed = change(known, now)
            if self._save_field(known.version, changed, counters.of_field(known, changed)) == "OK":
                return changed

    def create_field(self, record: FieldRecord, quota: Quota = NO_QUOTA) -> tuple[FieldRecord, bool]:
        while True:
            document, now = self._read(_key(record.sha256))
            known = FieldRecord(**document) if document is not None else None
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
        before: Any = self._redis.get(_attempts_key(record.sha256))
        return record if before is None else replace(record, attempt=record.attempt + int(before))

    def stored(self, owner: str) -> tuple[int, int]:
        sizes: Any = self._redis.hvals(_stored_key(owner))
        return len(sizes), sum(map(int, sizes))

    def restore_field(self, record: FieldRecord) -> bool:
        """Put a record that was lost back as it is; False when the field is known."""
        return self._save_field(0, record) == "OK"

    def get_field(self, sha256: str) -> FieldRecord | None:
        document, _ = self._read(_key(sha256))
        return FieldRecord(**document) if document is not None else None

    def get_fields(self, references: Sequence[str]) -> list[FieldRecord | None]:
        documents = self._read_each(map(_key, references))
        return [None if document is None else FieldRecord(**document) for document in documents]

    def list_fields(
        self, label: str | None, limit: int, before: tuple[float, str] | None, owner: str | None = None
    ) -> list[FieldRecord]:
        found: list[FieldRecord] = []
        index = _CREATED if owner is None else f"{_CREATED}:{owner}"
        for document in self._newest_first(index, _key, before):
            record = FieldRecord(**document)
            if label in (None, record.label):
                found.append(record)
            if len(found) == limit:
                break
        return found

    def update_field(self, sha256: str, *, attempt: int | None = None, **changes: Any) -> FieldRecord:
        return self._change_field(sha256, lambda known, now: transitions.changed_field(known, attempt, changes, now))

    def validating_fields(self) -> list[FieldRecord]:
        names = sorted(text(name) for name in self._redis.smembers(_VALIDATING))
        return [FieldRecord(**document) for document in self._read_many(map(_key, names))]

    def retry_import(self, sha256: str, attempt: int, *, lost: bool = True) -> FieldRecord:
        return self._change_field(sha256, lambda known, now: transitions.retried_field(known, attempt, now, lost))

    def delete_field(self, sha256: str) -> bool:
        while True:
            document, _ = self._read(_key(sha256))
            if document is None:
                return False
            commands: list[Command] = [
                ("DEL", _key(sha256)),
                *(("ZREM", each, sha256) for each in _created_keys(sha256)),
                ("SREM", _VALIDATING, sha256),
                ("HDEL", _stored_key(owner_of(sha256)), sha256),
                ("SET", _attempts_key(sha256), str(document["attempt"]), "EX", _ATTEMPTS_KEPT_S),
            ]
            if self._compare_and_set(_key(sha256), document["version"], commands) == "OK":
                return True
