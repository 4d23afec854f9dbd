"""Uploads that come in pieces: those that have arrived wait in the blob store for the rest.

A piece lies under the caller, the field's SHA-256, the offset at which it begins and the size of the whole. What has
arrived is the longest row of pieces without a gap, so front ends need to know nothing of each other. A piece that broke
off leaves nothing.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

from regnf_core.field_notes import MESH_NAMES, PICTURE_NAME
from regnf_state.blobs.base import BlobEntry, BlobStore
from regnf_state.settings import Settings

MOST_PIECES = 1000
"""Of one upload."""
_MOST_UPLOADS = 16
"""Of one caller."""
_TOP = "uploads"
_BLOCK = 1 << 20


@dataclass(frozen=True)
class Unfinished:
    """One upload that has begun. offset: how many bytes have arrived, without a gap · total: how many the whole has, by
    its first piece · bytes: what all pieces hold."""

    folder: str
    offset: int
    total: int
    pieces: int
    bytes: int
    modified: float


class Pieces:
    """The unfinished uploads. Any number of processes may use it at once. Methods raise OSError."""

    def __init__(self, blobs: BlobStore, settings: Settings) -> None:
        self._blobs = blobs
        self._kept_s = settings.keep_pieces_s
        self._most_bytes = settings.keep_pieces_bytes

    def key(self, caller: str, sha256: str, offset: int, total: int) -> str:
        """Where a piece lies."""
        return f"{_folder(caller, sha256)}/{offset:015d}-{total}"

    def find(self, caller: str, sha256: str) -> Unfinished:
        """What has arrived of one upload; of one that never began, nothing."""
        folder = _folder(caller, sha256)
        return _unfinished(folder, list(self._blobs.entries(folder)))

    def blocks(self, caller: str, sha256: str) -> Iterator[bytes]:
        """The bytes that have arrived, in order."""
        found = self.find(caller, sha256)
        offset = 0
        while offset < found.offset:
            with self._blobs.open(self.key(caller, sha256, offset, found.total)) as file:
                while block := file.read(_BLOCK):
                    offset += len(block)
                    yield block

    def drop(self, caller: str, sha256: str) -> None:
        """Forget an upload."""
        self._blobs.delete_prefix(_folder(caller, sha256))

    def bytes_of(self, caller: str) -> int:
        return sum(one.bytes for one in self._uploads(f"{_TOP}/{caller}"))

    def make_room(self, caller: str, sha256: str, coming: int) -> None:
        """The oldest other uploads of a caller go until it is within its bounds, with ``coming`` bytes of this one."""
        own = _folder(caller, sha256)
        others = [one for one in self._uploads(f"{_TOP}/{caller}") if one.folder != own]
        others.sort(key=lambda one: one.modified)
        total = sum(one.bytes for one in others) + coming
        while others and (len(others) >= _MOST_UPLOADS or total > self._most_bytes):
            oldest = others.pop(0)
            total -= oldest.bytes
            self._blobs.delete_prefix(oldest.folder)

    def unfinished(self) -> list[Unfinished]:
        """The uploads of all callers."""
        return list(self._uploads(_TOP))

    def expire(self, now: float) -> int:
        """Uploads of all callers that did not go on for as long as they are kept go: how many."""
        old = [one.folder for one in self.unfinished() if one.modified + self._kept_s <= now]
        for folder in old:
            self._blobs.delete_prefix(folder)
        return len(old)

    def _uploads(self, prefix: str) -> Iterator[Unfinished]:
        for folder, entries in groupby(self._blobs.entries(prefix), lambda entry: entry.key.rpartition("/")[0]):
            yield _unfinished(folder, list(entries))


def _folder(caller: str, sha256: str) -> str:
    return f"{_TOP}/{caller}/{sha256}"


def _unfinished(folder: str, entries: Sequence[BlobEntry]) -> Unfinished:
    offset = total = 0
    for entry in entries:  # sorted by their offsets
        begins, of = map(int, entry.key.rpartition("/")[2].split("-"))
        total = total or of
        if (begins, of) == (offset, total):
            offset += entry.bytes
    held = sum(entry.bytes for entry in entries)
    modified = max((entry.modified for entry in entries), default=0.0)
    return Unfinished(folder, offset, total, len(entries), held, modified)


# Where the mesh and the picture of a field lie, which workers make once the field is ready.


def view_key(reference: str, name: str) -> str:
    """Where what people look at of a field lies."""
    return f"fields/{reference}/{name}"


def delete_views(blobs: BlobStore, reference: str) -> None:
    """Delete what people look at of a field."""
    for name in (PICTURE_NAME, *MESH_NAMES):
        blobs.delete(view_key(reference, name))
