"""Byte ranges (RFC 9110, section 14): one range is honored, several are answered with the whole."""

from __future__ import annotations

import re
from dataclasses import dataclass

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
