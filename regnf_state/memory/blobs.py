"""Blobs in memory."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from regnf_state.blobs.base import BlobEntry, check_key


class _MemoryBlobWriter:
    def __init__(self, store: InMemoryBlobStore) -> None:
        self._store = store
        self._data = bytearray()

    def write(self, data: bytes) -> int:
        self._data += data
        return len(data)

    def commit(self, key: str) -> None:
        self._store.put(key, bytes(self._data))


class InMemoryBlobStore:
    """A BlobStore in a dictionary, ``blobs``."""

    def __init__(self) -> None:
        self.blobs: dict[str, bytes] = {}

    @contextmanager
    def writer(self) -> Iterator[_MemoryBlobWriter]:
        yield _MemoryBlobWriter(self)

    def put(self, key: str, data: bytes) -> None:
        self.blobs[check_key(key)] = data

    def put_if_absent(self, key: str, data: bytes) -> bool:
        if self.exists(key):
            return False
        self.put(key, data)
        return True

    def _get(self, key: str) -> bytes:
        try:
            return self.blobs[check_key(key)]
        except KeyError:
            raise FileNotFoundError(key) from None

    def open(self, key: str) -> BinaryIO:
        return io.BytesIO(self._get(key))

    @contextmanager
    def local_copy(self, key: str) -> Iterator[Path]:
        data = self._get(key)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / key.rsplit("/", 1)[-1]
            path.write_bytes(data)
            yield path

    def exists(self, key: str) -> bool:
        return check_key(key) in self.blobs

    def size(self, key: str) -> int:
        return len(self._get(key))

    def list(self, prefix: str) -> Iterator[str]:
        below = f"{check_key(prefix)}/" if prefix else ""
        return iter(sorted(key for key in self.blobs if key.startswith(below)))

    def delete(self, key: str) -> None:
        self.blobs.pop(check_key(key), None)

    def delete_prefix(self, prefix: str) -> None:
        for key in list(self.list(prefix)):
            del self.blobs[key]

    def entries(self, prefix: str) -> Iterator[BlobEntry]:
        return (BlobEntry(key, self.size(key), 0.0) for key in self.list(prefix))

    def sweep(self, older_than_s: float) -> int:  # noqa: ARG002 - nothing here outlives its writer
        return 0

    def probe(self) -> None:
        pass
