"""One upload on its way into the blob store: counted, hashed and looked at while it streams.

Nothing is stored elsewhere, and the bytes have no name before ``commit``: an interrupted upload leaves nothing.
Hashing and writing happen in a thread, a mebibyte at a time, so that the event loop keeps answering others.
"""

from __future__ import annotations

import hashlib
from collections.abc import AsyncIterator, Callable
from contextlib import ExitStack, asynccontextmanager
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import anyio
from anyio import CapacityLimiter, to_thread

from regnf_core.importing.containers.sniff import HEAD_BYTES, explain_refusal, sniff_format
from regnf_service.bytes_under_way import Claim
from regnf_service.problem import CLOSE, Problem
from regnf_service.services import Services
from regnf_state.blobs.base import BlobStore, BlobWriter

_BLOCK_BYTES = 1 << 20
_Result = TypeVar("_Result")


@dataclass(frozen=True)
class Received:
    """What arrived: the SHA-256 of the bytes in lower-case hexadecimal, and how many they were."""

    sha256: str
    bytes: int


class Upload:
    """Takes an upload's bytes in order. Use ``open_upload``; ``commit`` gives the bytes their name."""

    def __init__(self, blobs: BlobStore, limit: int, limiter: CapacityLimiter, claim: Claim) -> None:
        self._blobs = blobs
        self._opened = ExitStack()
        self._writer: BlobWriter | None = None
        """From the first block on: an upload that never sends as much costs the store nothing."""
        self._limit = limit
        self._limiter = limiter
        self._claim = claim
        self._hash = hashlib.sha256()
        self._bytes = 0
        self._pending = bytearray()
        self._recognized = False

    async def feed(self, data: bytes | bytearray) -> None:
        """Take the next bytes.

        Raises Problem UPLOAD_TOO_LARGE, QUOTA_STORED_BYTES, FIELD_NOT_RECOGNIZED as soon as the bytes show it.
        """
        if self._bytes + len(self._pending) + len(data) > self._limit:
            raise Problem("UPLOAD_TOO_LARGE", f"At most {self._limit} bytes are taken.", headers=CLOSE)
        self._claim.arrive(len(data))
        self._pending += data
        if not self._recognized and len(self._pending) >= HEAD_BYTES:
            self._recognize()
        if len(self._pending) >= _BLOCK_BYTES:
            await self._flush()

    async def finish(self) -> Received:
        """Write what is left. Raises Problem UPLOAD_EMPTY, FIELD_NOT_RECOGNIZED."""
        if not self._bytes and not self._pending:
            raise Problem("UPLOAD_EMPTY")
        if not self._recognized:
            self._recognize()
        await self._flush()
        return Received(self._hash.hexdigest(), self._bytes)

    async def commit(self, key: str) -> None:
        """Name the bytes, whole and at once."""
        assert self._writer is not None, "commit comes after finish"
        await self._in_thread(partial(self._writer.commit, key))
        self._claim.end()

    async def close(self) -> None:
        """What has no name goes."""
        if self._writer is not None:
            await self._in_thread(self._opened.close)

    def _recognize(self) -> None:
        head = bytes(self._pending[:HEAD_BYTES])
        if sniff_format(head) is None:
            _, sentence = explain_refusal(head)
            raise Problem("FIELD_NOT_RECOGNIZED", f"The file is {sentence}.", headers=CLOSE)
        self._recognized = True

    async def _flush(self) -> None:
        block, self._pending = self._pending, bytearray()
        await self._in_thread(lambda: self._take(block))

    def _take(self, block: bytearray) -> None:
        if self._writer is None:
            self._writer = self._opened.enter_context(self._blobs.writer())
        self._hash.update(block)
        self._writer.write(bytes(block))
        self._bytes += len(block)

    async def _in_thread(self, work: Callable[[], _Result]) -> _Result:
        return await to_thread.run_sync(work, limiter=self._limiter)


@asynccontextmanager
async def open_upload(services: Services, claim: Claim) -> AsyncIterator[Upload]:
    """A new upload into the blob store, within the settings' limits."""
    upload = Upload(services.blobs, services.settings.max_upload_bytes, services.upload_limiter, claim)
    try:
        yield upload
    finally:
        # also when the request is cancelled: what was written must go
        with anyio.CancelScope(shield=True):
            await upload.close()
