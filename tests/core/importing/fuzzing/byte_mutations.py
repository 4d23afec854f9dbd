"""Damage that knows nothing of a format: bytes and pieces changed, inserted, removed, moved, made telling numbers."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Sequence
from random import Random
from typing import TypeVar

Piece = TypeVar("Piece")

NUMBERS: tuple[int, ...] = (
    *(0, 1, 2, 0x7F, 0xFF, 0x100, 0x7FFF, 0xFFFF, 1 << 16, (1 << 31) - 1, 1 << 31, (1 << 32) - 1, 1 << 32),
    *((1 << 47), (1 << 48) - 1, 1 << 48, (1 << 62), (1 << 63) - 1, 1 << 63, (1 << 64) - 1),
)
"""Where counts, lengths and offsets change their nature."""
_TEXT_NUMBERS = (b"0", b"-1", b"2.5", b"1e308", b"1e309", b"5e-324", b"nan", b"9" * 20, b"1" + b"0" * 309)
"""Where a number that is written out is no count, no float or no number any more."""
_WRITTEN = re.compile(rb"-?[0-9][0-9.]*(?:e[-+]?[0-9]+)?")
_SEPARATORS = (rb"([ ,:=]+)", rb"(\s+)", rb"(\n)", rb"([^A-Za-z0-9_.+-])")
_MOST = 1 << 18
"""No case grows beyond this many bytes."""


def number(random: Random, width: int) -> bytes:
    """A telling number, little-endian, in ``width`` bytes."""
    return little(random.choice(NUMBERS), width)


def damaged(random: Random, data: bytes, other: bytes = b"") -> bytes:
    """``data`` after one to four changes; some take a piece of ``other``."""
    for _ in range(random.choice((1, 1, 1, 2, 2, 3, 4))):
        at, length = random.randrange(len(data) + 1), random.choice((1, 1, 2, 4, 8, 16, 64))
        head, piece, tail = data[:at], data[at : at + length], data[at + length :]
        width = random.choice((1, 2, 4, 8))
        here, there = random.randrange(len(data) + 1), random.randrange(len(other) + 1)
        middle = (
            *(b"", bytes([byte ^ (1 << random.randrange(8)) for byte in piece[:1]]) + piece[1:]),
            *(random.randbytes(len(piece)), random.randbytes(length) + piece, piece * random.choice((2, 3, 17))),
            *(other[there : there + length], data[here : here + length] + piece, number(random, width) + piece[width:]),
        )
        match random.randrange(10):
            case 0:
                data = head
            case 1:
                data = head + _WRITTEN.sub(random.choice(_TEXT_NUMBERS), piece + tail, count=1)
            case _:
                data = head + random.choice(middle) + tail
    return data[:_MOST]


def rearranged(
    random: Random, pieces: Sequence[Piece], others: Sequence[Piece], odd: Callable[[Piece], Piece]
) -> list[Piece]:
    """The pieces with one of them dropped, doubled, put elsewhere, preceded by some of ``others``, or made odd."""
    found, at = list(pieces), random.randrange(len(pieces))
    here, start = found[at : at + 1], random.randrange(len(others))
    match random.randrange(6):
        case 0:
            here = []
        case 1:
            here *= random.choice((2, 3, 300))
        case 2:
            here = [random.choice(found), *here]
        case 3:
            here = [*others[start : start + random.randrange(1, 30)], *here]
        case _:
            here = [odd(here[0])]
    found[at : at + 1] = here
    return found


def reworded(random: Random, text: bytes, words: Sequence[bytes], other: bytes = b"") -> bytes:
    """Text after one to four changes to its words or lines."""
    for _ in range(random.choice((1, 1, 2, 4))):
        separator = random.choice(_SEPARATORS)
        pieces, others = re.split(separator, text), re.split(separator, other or text)
        text = b"".join(rearranged(random, pieces, others, lambda word: random.choice((*words, b"  " * 3 + word))))
    return text


def little(value: int, width: int) -> bytes:
    """``value`` modulo 2^(8 width), little-endian."""
    return (value % (1 << 8 * width)).to_bytes(width, "little")


def double(value: float) -> bytes:
    """A pickle's float: big-endian."""
    return struct.pack(">d", value)
