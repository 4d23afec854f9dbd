"""Stored files as answers, a block at a time: whole, or a byte range (RFC 9110, section 14).

One range is honored, several are answered with the whole.
"""

from __future__ import annotations

import os
import re
from collections.abc import AsyncIterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, BinaryIO

from fastapi import Depends, Header
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse
from starlette.types import Receive, Scope, Send

from regnf_service.concurrency import in_thread
from regnf_service.http.etags import IfNoneMatch
from regnf_service.problem import Problem
from regnf_state.blobs.base import BlobStore

_ONE_RANGE = re.compile(r"bytes=([0-9]{0,18})-([0-9]{0,18})")


@dataclass(frozen=True)
class ByteRange:
    """``length`` bytes from ``start`` on."""

    start: int
    length: int


def parse_range(header: str | None, size: int) -> ByteRange | None:
    """The range asked for, None for the whole: no header, a malformed one, or more ranges than one.

    Raises Problem RANGE_NOT_SATISFIABLE.
    """
    match = _ONE_RANGE.fullmatch(header.strip()) if header else None
    if match is None or match.group(1) == match.group(2) == "":
        return None
    first, last = match.groups()
    if first == "":
        start, end = max(0, size - int(last)), size
        satisfiable = int(last) > 0 and size > 0
    else:
        start = int(first)
        end = min(int(last) + 1, size) if last else size
        if last and int(last) < start:
            return None
        satisfiable = start < size
    if not satisfiable:
        raise Problem("RANGE_NOT_SATISFIABLE", headers={"Content-Range": f"bytes */{size}"})
    return ByteRange(start, end - start)


@dataclass(frozen=True)
class RangeHeaders:
    """What a request says of the part that it wants. value: the header Range · if_range: the ETag that it belongs
    to."""

    value: str | None
    if_range: str | None

    def part(self, size: int, etag: str) -> ByteRange | None:
        """The part of ``size`` bytes; None: all of them. Raises Problem."""
        return parse_range(self.value, size) if self.if_range in (None, etag) else None


async def range_headers(
    range_: Annotated[str | None, Header(alias="Range", description="One range, `bytes=first-last`.")] = None,
    if_range: Annotated[str | None, Header(description="The ETag that the range belongs to.")] = None,
) -> RangeHeaders:
    """For a route's signature, by ``RangeDep``."""
    return RangeHeaders(range_, if_range)


RangeDep = Annotated[RangeHeaders, Depends(range_headers)]


class _FileAnswer(StreamingResponse):
    """Closes its file, however it ends."""

    def __init__(self, file: BinaryIO, part: ByteRange, block_bytes: int, **said: Any) -> None:
        super().__init__(_blocks(file, part, block_bytes), **said)
        self._file = file

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._file.close()


async def file_answer(
    request: Request,
    blobs: BlobStore,
    key: str,
    media_type: str,
    headers: Mapping[str, str],
    held: IfNoneMatch,
    part: ByteRange | None = None,
) -> Response:
    """The bytes of a blob, or a part of them; 304 where the client holds those with the ETag of ``headers``.

    At no time is more of it held than a block. Raises FileNotFoundError.
    """
    file, size = await in_thread(_opened, blobs, key)
    chosen = part or ByteRange(0, size)
    said = {**headers, "Content-Length": str(chosen.length)}
    if part is not None:
        said["Content-Range"] = f"bytes {part.start}-{part.start + part.length - 1}/{size}"
    status = 200 if part is None else 206
    if request.method == "HEAD" or held.matches(headers.get("ETag", "")):
        file.close()
        return held.apply(Response(None, status, said, media_type))
    return _FileAnswer(file, chosen, blobs.block_bytes, status_code=status, headers=said, media_type=media_type)


def _opened(blobs: BlobStore, key: str) -> tuple[BinaryIO, int]:
    file = blobs.stream(key)
    return file, file.seek(0, os.SEEK_END)


async def _blocks(file: BinaryIO, part: ByteRange, block_bytes: int) -> AsyncIterator[bytes]:
    """The part's bytes, each block read in a thread when the one before it is on its way."""
    left = part.length
    await in_thread(file.seek, part.start)
    while left and (block := await in_thread(file.read, min(left, block_bytes))):
        left -= len(block)
        yield block
