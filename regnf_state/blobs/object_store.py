"""Blobs as objects of an S3-compatible store: what several machines share besides Redis.

A blob of up to eight mebibytes is one request under its own key. A larger one streams to a temporary key, a multipart
upload that becomes an object whole or not at all, and is copied to its key within the store, which is atomic too.
Do not use a store in a process that forks afterwards: the client's threads do not survive a fork.
"""

from __future__ import annotations

import io
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, BinaryIO, TypeVar, cast
from uuid import uuid4

import obstore
from obstore.exceptions import AlreadyExistsError, BaseError, PreconditionError
from obstore.store import S3Store

from regnf_state.blobs.base import MAX_WAIT_S, BlobEntry, FileCache, StorageUnavailableError, check_key, until_available

if TYPE_CHECKING:
    from obstore import GetOptions, ObjectMeta


# The client of an S3-compatible store, and what its errors mean here.

_CONNECT_TIMEOUT_S = 5.0
_ENDPOINTS = ("AWS_ENDPOINT", "AWS_ENDPOINT_URL")


def object_client(url: str, wait_s: float, timeout_s: float) -> S3Store:
    """A client of the bucket and the prefix in ``url``, which repeats for ``wait_s`` what was certainly not done.

    A request may take ``timeout_s`` seconds. Endpoint and credentials are those of the usual AWS_* variables.
    """
    return S3Store.from_url(
        url,
        client_options={
            "timeout": timedelta(seconds=timeout_s),
            "connect_timeout": timedelta(seconds=_CONNECT_TIMEOUT_S),
            # an endpoint without TLS is used only when it is named so
            "allow_http": any(os.environ.get(name, "").startswith("http://") for name in _ENDPOINTS),
        },
        retry_config={
            "max_retries": 1000,
            "retry_timeout": timedelta(seconds=wait_s),
            "backoff": {
                "init_backoff": timedelta(seconds=0.1),
                "max_backoff": timedelta(seconds=MAX_WAIT_S),
                "base": 2,
            },
        },
    )


@contextmanager
def translate_errors() -> Iterator[None]:
    """Turns the client's errors into OSErrors; FileNotFoundError is one already."""
    try:
        yield
    except BaseError as error:
        raise StorageUnavailableError(f"the object store refused the request: {type(error).__name__}") from error


_TEMPORARY = ".tmp"
_PART_BYTES = 8 << 20
_PAGE = 1000
_PARTS_AT_ONCE = 2
_REQUEST_TIMEOUT_S = 20.0
"""For a whole request, which moves one part at most."""
_COPY_TIMEOUT_S = 600.0
"""For the store's own copying of a large object."""
_Value = TypeVar("_Value")


class ObjectBlobWriter:
    """An upload in progress. Leaving it without a commit aborts what was sent."""

    def __init__(self, store: ObjectBlobStore) -> None:
        self._store = store
        self._buffer = bytearray()
        self._temporary: str | None = None
        self._stream: Any = None

    def __enter__(self) -> ObjectBlobWriter:
        return self

    def write(self, data: bytes) -> int:
        self._buffer += data
        if len(self._buffer) > _PART_BYTES:
            self._send()
        return len(data)

    def _send(self) -> None:
        with translate_errors():
            if self._stream is None:
                self._temporary = f"{_TEMPORARY}/{uuid4().hex}"
                self._stream = obstore.open_writer(
                    self._store.client, self._temporary, buffer_size=_PART_BYTES, max_concurrency=_PARTS_AT_ONCE
                )
            self._stream.write(bytes(self._buffer))
        self._buffer.clear()

    def commit(self, key: str) -> None:
        check_key(key)
        if self._temporary is None:
            self._store.put(key, bytes(self._buffer))
            return
        self._send()
        with translate_errors():
            self._stream.close()
        self._stream = None
        source = self._temporary
        self._store.tried(lambda: obstore.copy(self._store.copier, source, key))

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with suppress(BaseError, OSError):  # what stays of it, a sweep or the bucket's own rule takes
            if self._stream is not None:
                # an exception, whichever, tells the client to abort rather than to complete
                self._stream.__exit__(InterruptedError, InterruptedError(), None)
            elif self._temporary is not None:
                obstore.delete(self._store.client, self._temporary)


class _RangedReader(io.RawIOBase):
    """An object read by ranges, as its reader asks for them."""

    def __init__(self, store: ObjectBlobStore, key: str, meta: ObjectMeta) -> None:
        self._store = store
        self._key = key
        self._meta = meta
        self._size = meta["size"]
        self._position = 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._position

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        start = {io.SEEK_SET: 0, io.SEEK_CUR: self._position, io.SEEK_END: self._size}[whence]
        self._position = max(0, start + offset)
        return self._position

    def readall(self) -> bytes:
        """In parts: the base class asks for eight kibibytes at a time."""
        parts = []
        while part := self.read(_PART_BYTES):
            parts.append(part)
        return b"".join(parts)

    def readinto(self, buffer: Any) -> int:
        end = min(self._size, self._position + len(buffer))
        if end <= self._position:
            return 0
        data = self._store.read_range(self._key, self._meta, self._position, end)
        buffer[: len(data)] = data
        self._position += len(data)
        return len(data)


class ObjectBlobStore:
    """A BlobStore in the bucket and below the prefix of an ``s3://`` address.

    The endpoint and the credentials are those of the usual AWS_* variables. A request that fails for the moment is
    repeated for ``wait_s`` seconds; then StorageUnavailableError is raised. Fields are kept in ``cache``, if given.
    """

    block_bytes = 512 * 1024

    def __init__(self, url: str, wait_s: float = 10.0, cache: FileCache | None = None) -> None:
        self._wait_s = wait_s
        self._cache = cache
        self.client = object_client(url, wait_s, _REQUEST_TIMEOUT_S)
        self.copier = object_client(url, wait_s, _COPY_TIMEOUT_S)

    def tried(self, do: Callable[[], _Value]) -> _Value:
        """What a request that may be repeated answers. Raises FileNotFoundError, StorageUnavailableError.

        The client repeats by itself what certainly was not done; a write that was not answered is repeated here.
        """

        def once() -> _Value:
            with translate_errors():
                return do()

        return until_available(once, self._wait_s)

    def writer(self) -> ObjectBlobWriter:
        return ObjectBlobWriter(self)

    def put(self, key: str, data: bytes) -> None:
        check_key(key)
        self.tried(lambda: obstore.put(self.client, key, data, use_multipart=False))

    def put_if_absent(self, key: str, data: bytes) -> bool:
        check_key(key)

        def create() -> bool:
            try:
                obstore.put(self.client, key, data, mode="create", use_multipart=False)
            except AlreadyExistsError:
                return False
            return True

        return self.tried(create)

    def open(self, key: str) -> BinaryIO:
        check_key(key)

        def whole() -> bytes | ObjectMeta:
            """The bytes of a small object, what is said of another."""
            answer = obstore.get(self.client, key)
            return bytes(answer.bytes()) if answer.meta["size"] <= _PART_BYTES else answer.meta

        found = self.tried(whole)
        if isinstance(found, bytes):
            return io.BytesIO(found)
        return io.BufferedReader(_RangedReader(self, key, found), buffer_size=4 << 20)

    def stream(self, key: str) -> BinaryIO:
        return cast(BinaryIO, _RangedReader(self, key, self._head(key)))

    @contextmanager
    def local_copy(self, key: str) -> Iterator[Path]:
        check_key(key)
        meta = self._head(key)
        if self._cache is not None and key.endswith(".safetensors"):
            name = "|".join((key, str(meta["e_tag"]), str(meta["size"])))  # the key alone may come to name other bytes
            with self._cache.held(name, lambda target: self._fetch(key, meta, target)) as path:
                yield path
            return
        with tempfile.TemporaryDirectory(prefix="blob-") as folder:
            path = Path(folder) / key.rsplit("/", 1)[-1]
            with path.open("wb") as target:
                self._fetch(key, meta, target)
            yield path

    def read_range(self, key: str, meta: ObjectMeta, start: int, end: int) -> bytes:
        """Bytes of the very object that ``meta`` tells of. Raises FileNotFoundError when another took its place."""

        def read() -> bytes:
            options: GetOptions = {"range": (start, end), "if_match": meta["e_tag"]}
            try:
                return bytes(obstore.get(self.client, key, options=options).bytes())
            except PreconditionError as error:
                raise FileNotFoundError(f"{key} was replaced") from error

        return self.tried(read)

    def _fetch(self, key: str, meta: ObjectMeta, target: BinaryIO) -> None:
        """Write the blob into a file, a part a request: each has its own time limit, and is repeated by itself."""
        for start in range(0, meta["size"], _PART_BYTES):
            target.write(self.read_range(key, meta, start, min(meta["size"], start + _PART_BYTES)))

    def _head(self, key: str) -> ObjectMeta:
        check_key(key)
        return self.tried(lambda: obstore.head(self.client, key))

    def exists(self, key: str) -> bool:
        try:
            self._head(key)
        except FileNotFoundError:
            return False
        return True

    def _entries(self, prefix: str) -> Iterator[BlobEntry]:
        with translate_errors():
            for page in obstore.list(self.client, prefix or None, chunk_size=_PAGE):
                for meta in page:
                    yield BlobEntry(meta["path"], meta["size"], meta["last_modified"].timestamp())

    def entries(self, prefix: str) -> Iterator[BlobEntry]:
        if prefix:
            check_key(prefix)
        return (entry for entry in self._entries(prefix) if not entry.key.startswith(f"{_TEMPORARY}/"))

    def list(self, prefix: str) -> Iterator[str]:
        return (entry.key for entry in self.entries(prefix))

    def delete(self, key: str) -> None:
        check_key(key)
        with suppress(FileNotFoundError):
            self.tried(lambda: obstore.delete(self.client, key))

    def delete_prefix(self, prefix: str) -> None:
        for key in list(self.list(prefix)):
            self.delete(key)

    def sweep(self, older_than_s: float) -> int:
        oldest = datetime.now(UTC).timestamp() - older_than_s
        left = [entry.key for entry in self._entries(_TEMPORARY) if entry.modified < oldest]
        for key in left:
            with suppress(FileNotFoundError):
                self.tried(lambda key=key: obstore.delete(self.client, key))  # type: ignore[misc]
        return len(left)

    def probe(self) -> None:
        name = f"{_TEMPORARY}/probe"
        self.tried(lambda: obstore.put(self.client, name, b"probe", use_multipart=False))
