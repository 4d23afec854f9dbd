"""Blobs as files below one folder."""

from __future__ import annotations

import builtins
import errno
import fcntl
import os
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, TypeVar
from uuid import uuid4

from regnf_state.blobs.base import (
    BlobEntry,
    BlobStore,
    StorageFullError,
    StorageUnavailableError,
    check_key,
    until_available,
)
from regnf_state.settings import Settings

_TEMPORARY = ".tmp"
_FULL = {errno.ENOSPC, errno.EDQUOT}
_Value = TypeVar("_Value")


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


class LocalBlobWriter(AbstractContextManager["LocalBlobWriter"]):
    """A temporary file on the store's volume, locked while its writer lives. A sweep deletes files without a lock."""

    def __init__(self, store: LocalBlobStore) -> None:
        self._store = store
        self._path, self._file = store.tried(self._create)

    def _create(self) -> tuple[Path, BinaryIO]:
        while True:
            path = self._store.temporary / uuid4().hex
            file = path.open("xb")
            fcntl.flock(file, fcntl.LOCK_EX)
            if os.fstat(file.fileno()).st_nlink:
                return path, file
            file.close()  # a sweep took it between its creation and its lock

    def write(self, data: bytes) -> int:
        with self._store.translate_errors():
            return self._file.write(data)

    def commit(self, key: str) -> None:
        if not self._store.tried(lambda: self._finish(key, replace=True)):
            raise AssertionError("a replacing commit always takes place")

    def commit_if_absent(self, key: str) -> bool:
        """Commit unless the key is taken."""
        return self._store.tried(lambda: self._finish(key, replace=False))

    def _finish(self, key: str, replace: bool) -> bool:
        target = self._store.path_of(key)
        self._file.flush()
        os.fsync(self._file.fileno())
        while True:
            self._store.require()  # before folders are made, which would be on another volume
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                if replace:
                    self._path.replace(target)
                else:
                    os.link(self._path, target)
                _sync_folder(target.parent)
            except FileExistsError:
                return False
            except FileNotFoundError:
                if not self._path.exists():
                    raise
                continue  # a deletion elsewhere removed the emptied folder: make it again
            return True

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with suppress(OSError):  # closing flushes, which a full disk refuses; what was committed is flushed already
            self._file.close()
        with suppress(OSError):  # a volume that is away keeps it; a sweep takes it
            self._path.unlink(missing_ok=True)


class LocalBlobStore:
    """A BlobStore in the folder ``root``, shared by any number of processes of one machine or one network volume.

    The folder for temporary files is made with the store: where it is missing, the volume is away, and that is waited
    for, ``wait_s`` seconds at most; then StorageUnavailableError is raised. ``existing``: nothing is made.
    """

    block_bytes = 64 * 1024

    def __init__(self, root: Path, wait_s: float = 0.0, existing: bool = False) -> None:
        self._wait_s = wait_s
        if not existing:
            root.mkdir(mode=0o700, parents=True, exist_ok=True)
            (root / _TEMPORARY).mkdir(exist_ok=True)
        self.root = root.resolve()
        self.temporary = self.root / _TEMPORARY
        if not existing:
            self.sweep()

    def require(self) -> None:
        """Raises StorageUnavailableError while the store is away."""
        if not self.temporary.is_dir():
            raise StorageUnavailableError(errno.ENODEV, "the blob store is not available")

    @contextmanager
    def translate_errors(self) -> Iterator[None]:
        """Tells a full volume, one that is away or fails, and a blob that is missing apart."""
        try:
            yield
        except (StorageFullError, StorageUnavailableError):
            raise
        except FileNotFoundError:
            self.require()
            raise
        except OSError as error:
            if error.errno in _FULL:
                raise StorageFullError(error.errno, "no space is left in the blob store") from error
            raise StorageUnavailableError(error.errno, f"the blob store failed: {error.strerror}") from error

    def tried(self, do: Callable[[], _Value]) -> _Value:
        """What ``do`` returns once the store is there."""

        def once() -> _Value:
            with self.translate_errors():
                return do()

        return until_available(once, self._wait_s)

    def sweep(self, older_than_s: float = 0.0) -> int:
        return self.tried(lambda: self._sweep(older_than_s))

    def _sweep(self, older_than_s: float) -> int:
        swept = 0
        oldest = time.time() - older_than_s
        for path in self.temporary.iterdir():
            with suppress(FileNotFoundError, BlockingIOError), path.open("rb") as file:
                if os.fstat(file.fileno()).st_mtime > oldest:
                    continue
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                path.unlink()
                swept += 1
        return swept

    def probe(self) -> None:
        with self.writer() as writer:
            writer.write(b"probe")

    def path_of(self, key: str) -> Path:
        """Where a blob lies. Raises ValueError for a malformed key, or one that a link leads out of the store."""
        path = self.root / check_key(key)
        if not path.resolve().is_relative_to(self.root):
            raise ValueError("the blob key is outside of the store")
        return path

    def writer(self) -> LocalBlobWriter:
        return LocalBlobWriter(self)

    def put(self, key: str, data: bytes) -> None:
        self.path_of(key)
        with self.writer() as writer:
            writer.write(data)
            writer.commit(key)

    def put_if_absent(self, key: str, data: bytes) -> bool:
        path = self.path_of(key)
        if path.exists():
            self.tried(lambda: _sync_folder(path.parent))  # whoever has written it may not have come so far
            return False
        with self.writer() as writer:
            writer.write(data)
            return writer.commit_if_absent(key)

    def open(self, key: str) -> BinaryIO:
        return self.tried(lambda: self.path_of(key).open("rb"))

    def stream(self, key: str) -> BinaryIO:
        return self.open(key)

    @contextmanager
    def local_copy(self, key: str) -> Iterator[Path]:
        if not self.exists(key):
            raise FileNotFoundError(errno.ENOENT, "no such blob", key)
        yield self.path_of(key)

    def exists(self, key: str) -> bool:
        return self.tried(lambda: self._there(self.path_of(key).is_file()))

    def _there(self, found: _Value) -> _Value:
        """What was found; before nothing is said to be there, the store must be."""
        if not found:
            self.require()
        return found

    def list(self, prefix: str) -> Iterator[str]:
        return iter(self.tried(lambda: self._there(self._keys(prefix))))

    def _keys(self, prefix: str) -> builtins.list[str]:
        top = self.path_of(prefix) if prefix else self.root
        found = []
        for folder, folders, files in os.walk(top, onerror=_unless_missing):
            folders[:] = [name for name in folders if not name.startswith(".")]
            found += [(Path(folder) / name).relative_to(self.root).as_posix() for name in files]
        return sorted(found)

    def entries(self, prefix: str) -> Iterator[BlobEntry]:
        for key in self.list(prefix):
            with suppress(FileNotFoundError):
                status = self.tried(lambda key=key: self.path_of(key).stat())  # type: ignore[misc]
                yield BlobEntry(key, status.st_size, status.st_mtime)

    def delete(self, key: str) -> None:
        self.tried(lambda: self._delete(self.path_of(key)))

    def _delete(self, path: Path) -> None:
        self.require()
        path.unlink(missing_ok=True)
        for folder in path.parents:
            if folder == self.root:
                break
            try:
                folder.rmdir()
            except OSError:
                break  # not empty, or another process removed it

    def delete_prefix(self, prefix: str) -> None:
        for key in self.list(prefix):
            self.delete(key)


def _unless_missing(error: OSError) -> None:
    """What os.walk would pass over: a listing must not look complete when a folder could not be read."""
    if not isinstance(error, FileNotFoundError):
        raise error


# The blob store that the settings name.


def open_blobs(settings: Settings, wait_s: float, existing: bool = False) -> BlobStore:
    """A local folder or an object store, which is waited for when it is away, ``wait_s`` seconds at most.

    ``existing``: a folder is not made. One that was there a moment ago is away, and another must not take its place.
    """
    if settings.storage_url is None:
        return LocalBlobStore(settings.blob_dir, wait_s, existing)
    from regnf_state.blobs.base import FileCache
    from regnf_state.blobs.object_store import ObjectBlobStore

    cache = FileCache(settings.field_cache_dir, settings.field_cache_bytes)
    return ObjectBlobStore(settings.storage_url, wait_s, cache)
