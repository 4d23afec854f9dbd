"""Byte ranges (RFC 9110, section 14): one range is honored, several are answered with the whole."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, Header

from regnf_service.problem import Problem

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
