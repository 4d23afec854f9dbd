"""One upload on its way into the blob store: counted, hashed and looked at while it streams; settings beside it too.

Nothing is stored elsewhere, and the bytes have no name before ``commit``: an interrupted upload leaves nothing.
Hashing and writing happen in a thread, a mebibyte at a time, so that the event loop keeps answering others.
"""

from __future__ import annotations

import hashlib
import re
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Self

import anyio

from regnf_core.importing.containers.sniff import HEAD_BYTES, explain_refusal, sniff_format
from regnf_service.concurrency import UPLOADS, Claim
from regnf_service.problem import Problem
from regnf_service.services import Services
from regnf_state.blobs.base import BlobWriter

_BLOCK_BYTES = 1 << 20
SETTINGS_BYTES = 64 << 20
"""The latent codes of a thousand shapes are the largest of settings."""
_NAME_LENGTH = 100
_NO_BYTES_HINT = "Check the path of the file: `curl --data-binary @room.ckpt` sends one."


@dataclass(frozen=True)
class Received:
    """What arrived: the SHA-256 of the bytes in lower-case hexadecimal, and how many they were."""

    sha256: str
    bytes: int


class Upload:
    """Takes an upload's bytes in order; ``commit`` gives them their name. What has none when the context ends goes."""

    format: str | None = None
    """What the bytes seem to be, once enough of them have come."""

    def __init__(self, services: Services, claim: Claim, limit: int | None = None) -> None:
        self._blobs = services.blobs
        self._opened = ExitStack()
        self._writer: BlobWriter | None = None
        """From the first block on: an upload that never sends as much costs the store nothing."""
        self._limit = services.settings.max_upload_bytes if limit is None else limit
        self._claim = claim
        self._hash = hashlib.sha256()
        self._bytes = 0
        self._pending = bytearray()
        self._recognized = False
        self._name = ""

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        # also when the request is canceled: what was written must go
        with anyio.CancelScope(shield=True):
            if self._writer is not None:
                await UPLOADS.run(self._opened.close)

    def begin(self, filename: str) -> None:
        """A part of a form has come. A field's name promises nothing, but may say what a refused file is."""
        self._name = filename

    async def feed(self, data: bytes | bytearray) -> None:
        """Take the next bytes.

        Raises Problem UPLOAD_TOO_LARGE, QUOTA_STORED, FIELD_NOT_RECOGNIZED as soon as the bytes show it.
        """
        if self._bytes + len(self._pending) + len(data) > self._limit:
            raise Problem("UPLOAD_TOO_LARGE", f"At most {self._limit} bytes are allowed.")
        self._claim.arrive(len(data))
        self._pending += data
        if not self._recognized and len(self._pending) >= HEAD_BYTES:
            self._recognize()
        if len(self._pending) >= _BLOCK_BYTES:
            await self._flush()

    async def finish(self) -> Received:
        """Write what is left. Raises Problem UPLOAD_INCOMPLETE, FIELD_NOT_RECOGNIZED."""
        if not self._bytes and not self._pending:
            raise Problem("UPLOAD_INCOMPLETE", "The upload is empty.", hint=_NO_BYTES_HINT)
        if not self._recognized:
            self._recognize()
        await self._flush()
        return Received(self._hash.hexdigest(), self._bytes)

    async def commit(self, key: str) -> None:
        """Name the bytes, whole and at once."""
        assert self._writer is not None, "commit comes after finish"
        await UPLOADS.run(self._writer.commit, key)
        self._claim.end()

    def _recognize(self) -> None:
        head = bytes(self._pending[:HEAD_BYTES])
        self.format = sniff_format(head)
        if self.format is None:
            _, sentence = explain_refusal(head, self._name)
            raise Problem("FIELD_NOT_RECOGNIZED", f"The file is {sentence}.")
        self._recognized = True

    async def _flush(self) -> None:
        block, self._pending = self._pending, bytearray()
        await UPLOADS.run(self._take, block)

    def _take(self, block: bytearray) -> None:
        if self._writer is None:
            self._writer = self._opened.enter_context(self._blobs.writer())
        self._hash.update(block)
        self._writer.write(bytes(block))
        self._bytes += len(block)


class SettingsUpload(Upload):
    """A trainer's settings that come with a field, and count as one upload with it: of any format, under a name that
    says something."""

    filename = "settings"
    came = False

    def __init__(self, services: Services, claim: Claim) -> None:
        super().__init__(services, claim, settings_limit(services))

    def begin(self, filename: str) -> None:
        """The part has come."""
        self.came = True
        self.filename = plain_name(filename) or self.filename

    async def received(self) -> ReceivedSettings | None:
        """What came; None where nothing did. Raises Problem UPLOAD_INCOMPLETE."""
        return ReceivedSettings(self.filename, self, await self.finish()) if self.came else None

    def _recognize(self) -> None:
        self._recognized = True


@dataclass(frozen=True)
class ReceivedSettings:
    """Settings whose bytes are all here."""

    name: str
    upload: SettingsUpload
    received: Received


def plain_name(filename: str) -> str:
    """The file's own name, without folders and without what could be more than a name."""
    name = re.split(r"[/\\]", filename)[-1]
    return re.sub(r"[^A-Za-z0-9._-]", "_", name)[-_NAME_LENGTH:].lstrip(".")


def settings_limit(services: Services) -> int:
    """The most bytes of settings."""
    return min(SETTINGS_BYTES, services.settings.max_upload_bytes)
