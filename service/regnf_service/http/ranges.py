"""Stored files as answers, a block at a time: whole, or a byte range (RFC 9110, section 14).

One range is honored, several are answered with the whole.
"""

from __future__ import annotations

import base64
import binascii
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
from regnf_service.fields.piecewise import PieceRange
from regnf_service.problem import Problem
from regnf_state.blobs.base import BlobStore
from regnf_state.records import FieldRecord

# Entity tags and `If-None-Match` (RFC 9110, sections 8.8.3 and 13.1.2).

_TAG = re.compile(r'(?:W/)?("[\x21\x23-\x7e\x80-\xff]*")')
_LIST = re.compile(rf"[ \t,]*{_TAG.pattern}(?:[ \t]*,[ \t,]*{_TAG.pattern})*[ \t,]*")
_KEPT = ("etag", "cache-control", "retry-after")


@dataclass(frozen=True)
class IfNoneMatch:
    """The condition that a request sets. ``given`` is False without a condition, or with a malformed one."""

    given: bool = False
    tags: frozenset[str] | None = frozenset()
    """The opaque tags, with their quotes; None means `*`, any tag."""

    def matches(self, etag: str) -> bool:
        """Whether the client holds this version. The comparison is weak: proxies may put `W/` before a tag."""
        return self.given and (self.tags is None or etag.removeprefix("W/") in self.tags)

    def differs(self, etag: str) -> bool:
        """Whether the client holds another version."""
        return self.given and not self.matches(etag)

    def apply(self, answer: Response) -> Response:
        """The answer, or 304 with its headers when the client holds that version."""
        if not self.matches(answer.headers.get("etag", "")):
            return answer
        return Response(
            status_code=304, headers={name: answer.headers[name] for name in _KEPT if name in answer.headers}
        )


def parse_if_none_match(header: str | None) -> IfNoneMatch:
    """The condition in a header; a malformed header sets none."""
    if header is not None and header.strip() == "*":
        return IfNoneMatch(True, None)
    if header is None or not _LIST.fullmatch(header):
        return IfNoneMatch()
    return IfNoneMatch(True, frozenset(_TAG.findall(header)))


def field_etag(record: FieldRecord) -> str:
    """Changes with every change of the field's record."""
    return f'"{record.sha256[:16]}.{record.version}"'


async def _of_request(
    if_none_match: Annotated[
        str | None,
        Header(description="One or several ETags, or `*`. The response is 304 if one of them is the current ETag."),
    ] = None,
) -> IfNoneMatch:
    return parse_if_none_match(if_none_match)


IfNoneMatchDep = Annotated[IfNoneMatch, Depends(_of_request)]


_ONE_RANGE = re.compile(r"bytes=([0-9]{0,18})-([0-9]{0,18})")


RangeHeader = Annotated[str | None, Header(alias="Range", description="One range, `bytes=first-last`.")]
IfRangeHeader = Annotated[str | None, Header(description="The ETag of the file that the range is from.")]


def parse_range(header: str | None, size: int) -> range | None:
    """The places of the bytes requested, None for all: no header, a malformed one, or more ranges than one.

    Raises Problem RANGE_NOT_SATISFIABLE.
    """
    match = _ONE_RANGE.fullmatch(header.strip()) if header else None
    if match is None or match[1] == match[2] == "" or (match[1] and match[2] and int(match[2]) < int(match[1])):
        return None
    start = int(match[1]) if match[1] else max(0, size - int(match[2]))
    end = min(int(match[2]) + 1, size) if match[1] and match[2] else size
    if start >= end:
        raise Problem("RANGE_NOT_SATISFIABLE", headers={"Content-Range": f"bytes */{size}"})
    return range(start, end)


class _FileAnswer(StreamingResponse):
    """Closes its file, however it ends."""

    def __init__(self, file: BinaryIO, part: range, block_bytes: int, **said: Any) -> None:
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
    part: range | None = None,
) -> Response:
    """The bytes of a blob, or a part of them; 304 where the client holds those with the ETag of ``headers``.

    At no time is more of it held than a block. Raises FileNotFoundError.
    """
    file, size = await in_thread(_opened, blobs, key)
    chosen = range(size) if part is None else part
    said = {**headers, "Content-Length": str(len(chosen))}
    if part is not None:
        said["Content-Range"] = f"bytes {part.start}-{part.stop - 1}/{size}"
    status = 200 if part is None else 206
    if request.method == "HEAD" or held.matches(headers.get("ETag", "")):
        file.close()
        return held.apply(Response(None, status, said, media_type))
    return _FileAnswer(file, chosen, blobs.block_bytes, status_code=status, headers=said, media_type=media_type)


def _opened(blobs: BlobStore, key: str) -> tuple[BinaryIO, int]:
    file = blobs.stream(key)
    return file, file.seek(0, os.SEEK_END)


async def _blocks(file: BinaryIO, part: range, block_bytes: int) -> AsyncIterator[bytes]:
    """The part's bytes, each block read in a thread when the one before it is on its way."""
    left = len(part)
    await in_thread(file.seek, part.start)
    while left and (block := await in_thread(file.read, min(left, block_bytes))):
        left -= len(block)
        yield block


# Content-Range of a request (RFC 9110, 14.4 and 14.5): which piece of a file the body is.

PATTERN = r"^bytes ([0-9]{1,15}-[0-9]{1,15}|\*)/[0-9]{1,15}$"
_RANGE = re.compile(r"bytes (?:([0-9]{1,15})-([0-9]{1,15})|\*)/([0-9]{1,15})", re.ASCII | re.IGNORECASE)


def content_range(header: str | None, limit: int) -> PieceRange | None:
    """What the header says; None without one. Raises Problem INVALID_HEADER, UPLOAD_TOO_LARGE, UPLOAD_INCOMPLETE."""
    if header is None:
        return None
    match = _RANGE.fullmatch(header.strip())
    if match is None:
        detail = "Content-Range is not `bytes first-last/total` or `bytes */total`."
        raise Problem("INVALID_HEADER", detail)
    first, last, total = (None if text is None else int(text) for text in match.groups())
    assert total is not None
    if total > limit:
        raise Problem("UPLOAD_TOO_LARGE", f"At most {limit} bytes are allowed.")
    if total == 0:
        raise Problem("UPLOAD_INCOMPLETE", "The upload is empty.")
    if first is None or last is None:
        return PieceRange(None, None, total)
    if not first <= last < total:
        raise Problem("INVALID_HEADER", "Content-Range has bytes after the end of the file, or no bytes.")
    return PieceRange(first, last + 1, total)


# The digests that clients announce: in a path, and in Content-Digest (RFC 9530).

_SHA256 = re.compile(r"[0-9a-f]{64}")
_MEMBER = re.compile(r"\s*([a-z0-9*_.-]{1,32})=:([A-Za-z0-9+/=]{0,128}):\s*")


def is_sha256(text: str) -> bool:
    """Whether the text is a SHA-256 as fields are named: 64 lower-case hexadecimal digits."""
    return _SHA256.fullmatch(text) is not None


def announced_digest(header: str | None) -> str | None:
    """The sha-256 of a Content-Digest header in hexadecimal; None when there is none to compare with.

    Raises Problem INVALID_DIGEST.
    """
    if header is None:
        return None
    for member in header.split(","):
        match = _MEMBER.fullmatch(member)
        if match is None:
            raise Problem("INVALID_DIGEST", "Content-Digest is not sha-256=:base64:.")
        if match.group(1) == "sha-256":
            return _decoded(match.group(2))
    return None


def _decoded(text: str) -> str:
    try:
        value = base64.b64decode(text, validate=True)
    except binascii.Error:
        value = b""
    if len(value) != 32:
        raise Problem("INVALID_DIGEST", "Content-Digest has no SHA-256.")
    return value.hex()
