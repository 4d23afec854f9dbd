"""Batches in the storage: what was posted together, and which job each of its lines became.

    batches/{owner}/{id}     a line of JSON for the batch, then one for each pair

That is all that is kept of a batch. Its jobs are jobs like any others: they tell how far it is. It is written last,
when all jobs are accepted, and whole; posting the same lines again replaces it by its like.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from regnf_state.blobs.base import BlobEntry, BlobStore
from regnf_state.record_store import Page, Position
from regnf_state.records import FORMAT, UnreadableRecordError, check_json_format

_ALL = "batches"
_PROBLEM_BYTES = 1024
_TEXT = 300
"""Most that is kept of a line's problem: of all of it, or of each text where it is longer."""
logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Pair:
    """One line of a batch. line: its number in the body, from 1 on · error: why it has become no job."""

    line: int
    key: str | None
    job: str | None
    error: dict[str, Any] | None = None


@dataclass(frozen=True)
class Batch:
    """One batch. created: when it was posted last."""

    id: str
    owner: str
    created: float
    pairs: tuple[Pair, ...]

    @property
    def jobs(self) -> list[str]:
        """Its jobs, each once."""
        return list(dict.fromkeys(pair.job for pair in self.pairs if pair.job is not None))

    def text(self) -> bytes:
        head = {"format": FORMAT, "created": self.created, "pairs": len(self.pairs)}
        lines = [[pair.line, pair.key, pair.job, _short(pair.error)] for pair in self.pairs]
        return b"".join(_line(one) for one in (head, *lines))


@dataclass(frozen=True)
class BatchSummary:
    """What lists tell of a batch. pairs: how many it has."""

    id: str
    created: float
    pairs: int


class Batches:
    """The batches of one service. Any number of processes may use it at once. Methods raise OSError."""

    def __init__(self, blobs: BlobStore) -> None:
        self._blobs = blobs

    def put(self, batch: Batch) -> None:
        self._blobs.put(_key(batch.owner, batch.id), batch.text())

    def find(self, owner: str, batch_id: str) -> Batch | None:
        """Raises UnreadableRecordError."""
        try:
            with self._blobs.open(_key(owner, batch_id)) as file:
                head, *lines = file.read().splitlines()
        except (FileNotFoundError, ValueError):
            return None
        try:
            pairs = tuple(Pair(*json.loads(line)) for line in lines)
        except (ValueError, TypeError) as error:
            raise UnreadableRecordError(batch_id, "the record of a pair is damaged") from error
        return Batch(batch_id, owner, _summary(batch_id, head).created, pairs)

    def delete(self, owner: str, batch_id: str) -> None:
        """Delete a batch; its jobs stay."""
        self._blobs.delete(_key(owner, batch_id))

    def kept(self, owner: str) -> list[BlobEntry]:
        """What is stored of an owner's batches, those posted last first."""
        found = self._blobs.entries(f"{_ALL}/{owner}")
        return sorted(found, key=lambda entry: (entry.modified, entry.key), reverse=True)

    def bytes_of(self, owner: str) -> int:
        """What they take."""
        return sum(entry.bytes for entry in self.kept(owner))

    def page(self, owner: str, limit: int, before: Position | None) -> Page[BatchSummary]:
        """An owner's batches, those posted last first. One that goes meanwhile is left out."""
        positions = [(entry.modified, entry.key.rpartition("/")[2]) for entry in self.kept(owner)]
        older = [one for one in positions if before is None or one < before]
        found = [summary for _, batch_id in older[:limit] if (summary := self._told(owner, batch_id)) is not None]
        return Page(found, older[limit - 1] if len(older) > limit else None)

    def _told(self, owner: str, batch_id: str) -> BatchSummary | None:
        try:
            with self._blobs.open(_key(owner, batch_id)) as file:
                return _summary(batch_id, file.readline())
        except FileNotFoundError:
            return None
        except UnreadableRecordError as error:
            logger.error("%s", error)
            return None

    def entries(self) -> list[BlobEntry]:
        """What is stored of everybody's batches, the oldest first."""
        return sorted(self._blobs.entries(_ALL), key=lambda entry: (entry.modified, entry.key))

    def expire(self, moment: float, confirm: Callable[[], None]) -> list[str]:
        """Forget batches that were posted before; their ids."""
        old = [entry.key for entry in self.entries() if entry.modified <= moment]
        for key in old:
            confirm()
            self._blobs.delete(key)
        return [key.rpartition("/")[2] for key in old]


def _key(owner: str, batch_id: str) -> str:
    return f"{_ALL}/{owner}/{batch_id}"


def _summary(batch_id: str, head: bytes) -> BatchSummary:
    try:
        told = check_json_format(batch_id, json.loads(head))
        return BatchSummary(batch_id, float(told["created"]), int(told["pairs"]))
    except (ValueError, KeyError, TypeError) as error:
        raise UnreadableRecordError(batch_id, "it is damaged") from error


def _short(problem: dict[str, Any] | None) -> dict[str, Any] | None:
    """The problem, without the details of its faults where these are long."""
    if problem is None or len(_line(problem)) <= _PROBLEM_BYTES:
        return problem
    return {
        name: value[:_TEXT] if isinstance(value, str) else value for name, value in problem.items() if name != "errors"
    }


def _line(value: Any) -> bytes:
    return json.dumps(value, ensure_ascii=False, separators=(",", ":")).encode() + b"\n"
