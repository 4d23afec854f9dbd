"""MessagePack, read by its common library within limits, unpacked from gzip first."""

from __future__ import annotations

import zlib
from typing import Any

import msgpack

from regnf_core.errors import FieldFormatError

_MOST_VALUES, _LONGEST = 2_000_000, 100_000
"""Of all lists and maps together, and of one. A snapshot with two thousand cameras has a tenth of them."""
_RATIO, _FREE = 200, 64 << 20
"""Unpacked bytes: so many times the packed ones, beyond those that are allowed in any case."""


def unpacked(data: memoryview, most: int) -> memoryview:
    """``data`` itself, or what is in it if it is packed by gzip: ``most`` bytes at most.

    Raises FieldFormatError: ARCHIVE_TOO_LARGE, FORMAT_NOT_SUPPORTED for a damaged file, FILE_TRUNCATED.
    """
    if bytes(data[:2]) != b"\x1f\x8b":
        return data
    stream, allowed = zlib.decompressobj(31), min(most, max(_FREE, _RATIO * len(data)))
    try:
        found = stream.decompress(data, allowed)
    except zlib.error as error:
        raise FieldFormatError("the packed file is damaged", reason="FORMAT_NOT_SUPPORTED") from error
    if stream.unconsumed_tail:
        message = f"the file has more than {allowed >> 20} MiB when it is unpacked"
        raise FieldFormatError(message, reason="ARCHIVE_TOO_LARGE")
    if not stream.eof:
        raise FieldFormatError("the packed file ends too early", reason="FILE_TRUNCATED")
    return memoryview(found)


def read_msgpack(data: memoryview) -> Any:
    """The one value in ``data``. Raises FieldFormatError: FILE_TRUNCATED, FORMAT_NOT_SUPPORTED."""
    left = _MOST_VALUES

    def counted(values: Any) -> Any:
        nonlocal left
        left -= len(values)
        if left < 0:
            raise ValueError(f"more than {_MOST_VALUES} values")
        return values

    def mapped(pairs: list[tuple[Any, Any]]) -> dict[Any, Any]:
        found = dict(counted(pairs))
        if len(found) != len(pairs):
            raise ValueError("a key occurs twice")
        return found

    limits = {"max_array_len": _LONGEST, "max_map_len": _LONGEST, "max_str_len": 1 << 20, "max_bin_len": len(data)}
    try:
        return msgpack.unpackb(data, list_hook=counted, object_pairs_hook=mapped, **limits)
    except (ValueError, msgpack.UnpackException, RecursionError) as error:
        if str(error) == "Unpack failed: incomplete input":
            raise FieldFormatError("the file ends within a value", reason="FILE_TRUNCATED") from error
        message = f"not a valid MessagePack file: {str(error)[:100]}"
        raise FieldFormatError(message, reason="FORMAT_NOT_SUPPORTED") from error
