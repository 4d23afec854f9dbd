"""Where bytes live: uploads, regnf field files, results. Keys are relative, '/'-separated and never leave the store.

Keys in use:
    fields/{sha256}/original               the upload, until its import has ended or as long as it is kept
    fields/{sha256}/settings-{sha256}      the trainer's settings that came with it, for as long
    fields/{sha256}/field.safetensors      the regnf field file, or the recording, that workers open
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

import fcntl
import os
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import BinaryIO, Protocol, TypeVar
from uuid import uuid4


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


# Waiting for a storage that is away for the moment.

MAX_WAIT_S = 2.0
_FIRST_WAIT_S = 0.1
_Value = TypeVar("_Value")


def until_available(do: Callable[[], _Value], wait_s: float) -> _Value:
    """What ``do`` returns; it may be called several times. Raises StorageUnavailableError after ``wait_s`` seconds."""
    end = time.monotonic() + wait_s
    pause_s = _FIRST_WAIT_S
    while True:
        try:
            return do()
        except StorageUnavailableError:
            if time.monotonic() + pause_s > end:
                raise
        time.sleep(pause_s)
        pause_s = min(2 * pause_s, MAX_WAIT_S)


# Copies of remote files on this machine, shared by its processes and kept below a size.
#
# A process that uses a file holds a shared lock on it. To make room, only files without a lock are deleted, the least
# recently used first. A file gets its name by a link when it is complete, so readers never see a part of one.

_UNFINISHED = ".part"


class FileCache:
    """Files below ``folder``, at most ``max_bytes`` of them beside those in use."""

    def __init__(self, folder: Path, max_bytes: int) -> None:
        self._folder = folder
        self._max_bytes = max_bytes

    @contextmanager
    def held(self, name: str, fetch: Callable[[BinaryIO], None]) -> Iterator[Path]:
        """The file called ``name``, fetched if it is not here, for as long as the block lasts."""
        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        path = self._folder / sha256(name.encode()).hexdigest()
        while (file := _locked(path)) is None:
            self._fetch(path, fetch)
        with file:
            os.utime(path)
            self._make_room()
            yield path

    def _fetch(self, path: Path, fetch: Callable[[BinaryIO], None]) -> None:
        temporary = self._folder / f"{uuid4().hex}{_UNFINISHED}"
        try:
            with temporary.open("xb") as file:
                fcntl.flock(file, fcntl.LOCK_EX)
                fetch(file)
                file.flush()
                # another process was faster, and its file may be in use; or one making room saw this one unlocked
                with suppress(FileExistsError, FileNotFoundError):
                    os.link(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)

    def _make_room(self) -> None:
        found = []
        for path in self._folder.iterdir():
            with suppress(FileNotFoundError):
                found.append((path.stat(), path))
        total = sum(status.st_size for status, _ in found)
        for status, path in sorted(found, key=lambda one: one[0].st_mtime_ns):
            if path.suffix != _UNFINISHED and total <= self._max_bytes:
                continue
            if _removed(path):
                total -= status.st_size


def _locked(path: Path) -> BinaryIO | None:
    """The file, open and locked against removal; None when it is not, or no longer, there."""
    try:
        file = path.open("rb")
    except FileNotFoundError:
        return None
    fcntl.flock(file, fcntl.LOCK_SH)
    with suppress(FileNotFoundError):
        if os.path.samestat(os.fstat(file.fileno()), path.stat()):
            return file
    file.close()
    return None


def _removed(path: Path) -> bool:
    with suppress(FileNotFoundError, BlockingIOError), path.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        path.unlink()
        return True
    return False
