"""Where bytes live: uploads, safe fields, results. Keys are relative, '/'-separated and never leave the store.

Keys in use:
    fields/{sha256}/original               the upload, until its import has ended or as long as it is kept
    fields/{sha256}/settings-{sha256}      the trainer's settings that came with it, for as long
    fields/{sha256}/field.safetensors      the safe field that workers open
    fields/{sha256}/object-model-{n}.safetensors   its model as an object by revision n of the engine; the first job
                                           that needs the model makes it, or a library's entry
    fields/{sha256}/preview.png, mesh.glb, mesh-coarse.glb   what people look at; workers make it when they have time
    jobs/{id}/{attempt}/{artifact}         what an attempt wrote; the manifest names the attempt that counts
    jobs/{id}/manifest.json                written after the result, atomically: what it lists counts
    jobs/{id}/rest.json                    the same for pictures and clouds, which come later
    uploads/{caller}/{sha256}/{offset}-{total}   the pieces of an upload that is not finished: see regnf_state.pieces
    batches/...                            batches of registrations and their results: see regnf_state.batches
    journal/jobs/{id}/{attempt}-{event}    what was accepted and how it ended: see regnf_state.journal.journal
    journal/fields/{sha256}                a field's record as it was last written
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Protocol


class StorageFullError(OSError):
    """No space is left for the bytes."""


class StorageUnavailableError(OSError):
    """The store does not answer, or refuses for reasons of its own."""


@dataclass(frozen=True)
class BlobEntry:
    """One blob of a listing; ``modified`` in seconds since the epoch, by the store's clock."""

    key: str
    bytes: int
    modified: float


def check_key(key: str) -> str:
    """The key itself. Raises ValueError for one that is malformed or tries to leave the store."""
    parts = key.split("/")
    if (
        not key
        or len(key) > 512
        or "\\" in key
        or any(not part or part.startswith(".") or len(part) > 200 for part in parts)
        or any(ord(character) < 32 or ord(character) > 126 for character in key)
    ):
        raise ValueError("malformed blob key")
    return key


class BlobWriter(Protocol):
    """An open, unnamed blob. It gets its name, whole, with ``commit``; without it nothing stays behind."""

    def write(self, data: bytes) -> int: ...

    def commit(self, key: str) -> None: ...


class BlobStore(Protocol):
    """Blobs by key. Missing keys raise FileNotFoundError, malformed ones ValueError. Every method is blocking."""

    block_bytes: int
    """As few as can be read at once without being slow."""

    def writer(self) -> AbstractContextManager[BlobWriter]: ...

    def put(self, key: str, data: bytes) -> None: ...

    def put_if_absent(self, key: str, data: bytes) -> bool:
        """Atomic: of several writers one wins (True), the others change nothing (False)."""
        ...

    def open(self, key: str) -> BinaryIO: ...

    def stream(self, key: str) -> BinaryIO:
        """The same for what is sent on as it is read: nothing is read ahead. Read ``block_bytes`` at a time."""
        ...

    def local_copy(self, key: str) -> AbstractContextManager[Path]:
        """A readable file with the blob's bytes: the file itself where the store is local."""
        ...

    def exists(self, key: str) -> bool: ...

    def size(self, key: str) -> int: ...

    def list(self, prefix: str) -> Iterator[str]:
        """Keys below the folder ``prefix`` ("jobs/{id}"), sorted; "" lists all."""
        ...

    def entries(self, prefix: str) -> Iterator[BlobEntry]:
        """The same with sizes and times."""
        ...

    def delete(self, key: str) -> None:
        """Delete one blob; a missing one is no error."""
        ...

    def delete_prefix(self, prefix: str) -> None:
        """Delete every blob below the folder ``prefix``."""
        ...

    def sweep(self, older_than_s: float) -> int:
        """Delete what writers that died this long ago have left behind; how many blobs that were."""
        ...

    def probe(self) -> None:
        """Returns when the store takes bytes. Raises OSError."""
        ...
