"""Batches in the storage: what was posted, and the results in numbered blocks, each written once.

    batches/heads/{owner}/{id}                   the head; written last, and gone first
    batches/data/{owner}/{id}/pairs              the lines as they were posted, checked
    batches/data/{owner}/{id}/results/{block}    the state after the block; then a line for each pair that has ended

A change of a batch is its next block. Of several processes that would write it one wins, the others see that they were
late and look again. So nothing is lost or written twice, whichever process ends when, and whatever Redis loses.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import islice
from typing import Any

from regnf_state.batch_records import (
    Batch,
    BatchName,
    BatchState,
    Pair,
    head_text,
    read_head,
    read_pair,
    read_state,
    state_text,
)
from regnf_state.blobs.base import BlobStore, BlobWriter
from regnf_state.pages import Page, Position
from regnf_state.records import RecordError, UnreadableRecordError
from regnf_state.redis.batch_index import BatchIndex

_HEADS = "batches/heads"
_DATA = "batches/data"
_DAY_S = 24 * 3600.0
logger = logging.getLogger(__name__)


class StaleBatchError(RecordError):
    """Another process has changed the batch in between."""


class Batches:
    """The batches of one service. Any number of processes may use it at once. Methods raise RedisError, OSError."""

    def __init__(self, blobs: BlobStore, index: BatchIndex, retention_s: int) -> None:
        self._blobs = blobs
        self._retention_s = retention_s
        self.index = index

    # one batch

    def create(self, batch: Batch, pairs: BlobWriter, now: float) -> tuple[Batch, bool]:
        """Keep a batch whose lines were written to ``pairs``, or return the one that exists (False)."""
        known = self.find(batch.name)
        if known is not None:
            return known, False
        state = BatchState(since=now, updated=now)
        pairs.commit(f"{_folder(batch.name)}/pairs")
        self._blobs.put_if_absent(_block_key(batch.name, 0), state_text(state))
        created = self._blobs.put_if_absent(_head_key(batch.name), head_text(batch))
        self.index.enter(batch, state if created else self._last(batch.name))
        return batch, created

    def find(self, name: BatchName) -> Batch | None:
        """Raises UnreadableRecordError."""
        try:
            with self._blobs.open(_head_key(name)) as file:
                return read_head(name, file.read())
        except (FileNotFoundError, ValueError):
            return None

    def state(self, name: BatchName) -> BatchState:
        """Where a batch is. Raises FileNotFoundError for one that is gone, UnreadableRecordError."""
        known = self.index.state(name)
        return self._last(name) if known is None else known

    def _last(self, name: BatchName) -> BatchState:
        """What the last block says."""
        keys = list(self._blobs.list(f"{_folder(name)}/results"))
        if not keys:
            raise FileNotFoundError(f"batch {name.id}")
        return self._head_of(name, len(keys) - 1)

    def _head_of(self, name: BatchName, block: int) -> BatchState:
        with self._blobs.open(_block_key(name, block)) as file:
            return read_state(name.id, file.readline())

    def write(self, name: BatchName, after: BatchState, lines: Sequence[dict[str, Any]] = ()) -> BatchState:
        """Write the next block: ``after`` is the state that follows the known one. Raises StaleBatchError."""
        numbered = [{"number": after.lines + n, **line} for n, line in enumerate(lines, 1)]
        state = replace(after, block=after.block + 1, lines=after.lines + len(lines))
        told = b"".join(json.dumps(line, separators=(",", ":")).encode() + b"\n" for line in numbered)
        if not self._blobs.exists(_head_key(name)) or not self._blobs.put_if_absent(
            _block_key(name, state.block), state_text(state) + told
        ):
            self.index.forget_state(name)
            raise StaleBatchError(f"batch {name.id} has changed")
        self.index.note(name, state)
        return state

    def pairs(self, name: BatchName, number: int, offset: int) -> Iterator[Pair]:
        """The pairs from this one on. Raises UnreadableRecordError."""
        with self._blobs.open(f"{_folder(name)}/pairs") as file:
            file.seek(offset)
            for text in file:
                pair = read_pair(name.id, number, offset, text)
                yield pair
                number, offset = number + 1, pair.end

    def results(self, name: BatchName, state: BatchState, after: int = 0) -> Iterator[bytes]:
        """The result lines behind the first ``after``, as they were when the batch had this state."""
        for block in range(self._block_of(name, state, after), state.block + 1):
            with self._blobs.open(_block_key(name, block)) as file:
                lines = file.read().splitlines(keepends=True)
            ended = read_state(name.id, lines[0]).lines
            yield from islice(lines[1:], max(0, after - (ended - len(lines) + 1)), None)

    def _block_of(self, name: BatchName, state: BatchState, after: int) -> int:
        """The first block at whose end there are more than ``after`` lines."""
        low, high = 0, state.block + 1
        if after >= state.lines:
            return high
        while after and low < high:
            middle = (low + high) // 2
            if self._head_of(name, middle).lines > after:
                high = middle
            else:
                low = middle + 1
        return low

    def delete(self, name: BatchName, expired_s: int | None = None) -> None:
        """Forget a batch; its jobs stay."""
        self._blobs.delete(_head_key(name))
        self._blobs.delete_prefix(_folder(name))
        self.index.drop(name, expired_s)

    # all of them

    def page(self, owner: str, limit: int, before: Position | None) -> Page[Batch]:
        """An owner's batches, newest first."""
        self.rebuild_if_needed()
        found: list[Batch] = []
        last = before
        for position in self.index.newest_first(owner, before):
            if len(found) == limit:
                return Page(found, last)
            batch = self._readable(BatchName(owner, position[1]))
            found += [] if batch is None else [batch]
            last = position
        return Page(found, None)

    def _readable(self, name: BatchName) -> Batch | None:
        try:
            return self.find(name)
        except UnreadableRecordError as error:
            logger.error("%s", error)
            return None

    def rebuild_if_needed(self) -> int:
        """Read the storage where Redis has lost the index: how many batches were found."""
        if self.index.is_current():
            return 0
        found = 0
        for key in self._blobs.list(_HEADS):
            owner, _, batch_id = key.removeprefix(f"{_HEADS}/").partition("/")
            batch = self._readable(BatchName(owner, batch_id))
            try:
                if batch is not None:
                    self.index.enter(batch, self._last(batch.name))
                    found += 1
            except (FileNotFoundError, UnreadableRecordError) as error:
                logger.error("batch %s does not read: %s", batch_id, error)
        self.index.mark_current()
        return found

    def expire(self, now: float) -> list[str]:
        """Batches whose end is as long ago as they are kept go: their ids."""
        old = self.index.ended_before(now - self._retention_s)
        for name in old:
            self.delete(name, self._retention_s)
        return [name.id for name in old]

    def sweep(self, now: float) -> int:
        """Lines that a process left behind which died before the head was written: how many batches."""
        last: dict[BatchName, float] = {}
        for entry in self._blobs.entries(_DATA):
            owner, batch_id, _ = entry.key.removeprefix(f"{_DATA}/").split("/", 2)
            name = BatchName(owner, batch_id)
            last[name] = max(last.get(name, 0.0), entry.modified)
        gone = [name for name, time in last.items() if time + _DAY_S <= now and not self._blobs.exists(_head_key(name))]
        for name in gone:
            self._blobs.delete_prefix(_folder(name))
        return len(gone)


def numbers_with(lines: Iterable[bytes], status: str) -> set[int]:
    """The pairs whose last result line has this status."""
    last: dict[int, str] = {}
    for line in lines:
        told = json.loads(line)
        last[told["pair"]] = told["status"]
    return {number for number, held in last.items() if held == status}


def _head_key(name: BatchName) -> str:
    return f"{_HEADS}/{name.owner}/{name.id}"


def _folder(name: BatchName) -> str:
    return f"{_DATA}/{name.owner}/{name.id}"


def _block_key(name: BatchName, block: int) -> str:
    return f"{_folder(name)}/results/{block:08d}"
