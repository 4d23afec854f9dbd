"""Damage that knows nothing of a format: bytes flipped, inserted, removed, moved, replaced by telling numbers."""

from __future__ import annotations

import re
import struct
from random import Random

NUMBERS: tuple[int, ...] = (
    *(0, 1, 2, 0x7F, 0xFF, 0x100, 0x7FFF, 0xFFFF, 1 << 16, (1 << 31) - 1, 1 << 31, (1 << 32) - 1, 1 << 32),
)
NUMBERS += ((1 << 47), (1 << 48) - 1, 1 << 48, (1 << 62), (1 << 63) - 1, 1 << 63, (1 << 64) - 1)
"""Where counts, lengths and offsets change their nature."""
_TEXT_NUMBERS = (b"0", b"-1", b"2.5", b"1e308", b"1e309", b"5e-324", b"nan", b"9" * 20, b"1" + b"0" * 309)
"""Where a number that is written out is no count, no float or no number any more."""
_WRITTEN = re.compile(rb"-?[0-9][0-9.]*(?:e[-+]?[0-9]+)?")
_MOST = 1 << 18
"""No case grows beyond this many bytes."""


def number(random: Random, width: int) -> bytes:
    """A telling number, little-endian, in ``width`` bytes."""
    return (random.choice(NUMBERS) % (1 << 8 * width)).to_bytes(width, "little")


def damaged(random: Random, data: bytes, other: bytes = b"") -> bytes:
    """``data`` after one to four changes; some take a piece of ``other``."""
    for _ in range(random.choice((1, 1, 1, 2, 2, 3, 4))):
        at, length = random.randrange(len(data) + 1), random.choice((1, 1, 2, 4, 8, 16, 64))
        data = _changed(random, data, at, length, other)
    return data[:_MOST]


def _changed(random: Random, data: bytes, at: int, length: int, other: bytes) -> bytes:
    head, piece, tail = data[:at], data[at : at + length], data[at + length :]
    match random.randrange(10):
        case 0 if piece:
            flipped = piece[0] ^ (1 << random.randrange(8))
            return head + bytes([flipped]) + piece[1:] + tail
        case 1:
            return head + random.randbytes(len(piece)) + tail
        case 2:
            return head + tail
        case 3:
            return head + random.randbytes(length) + piece + tail
        case 4:
            return head + piece * random.choice((2, 3, 17)) + tail
        case 5:
            start = random.randrange(len(other) + 1)
            return head + other[start : start + length] + tail
        case 6:
            start = random.randrange(len(data) + 1)
            return head + data[start : start + length] + piece + tail
        case 7:
            return head
        case 8:
            return head + _WRITTEN.sub(random.choice(_TEXT_NUMBERS), data[at:], count=1)
        case _:
            width = random.choice((1, 2, 4, 8))
            return head + number(random, width) + data[at + width :]


def little(value: int, width: int) -> bytes:
    """``value`` modulo 2^(8 width), little-endian."""
    return (value % (1 << 8 * width)).to_bytes(width, "little")


def double(value: float) -> bytes:
    """A pickle's float: big-endian."""
    return struct.pack(">d", value)
