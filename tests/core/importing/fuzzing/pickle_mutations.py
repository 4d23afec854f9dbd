"""Damage that knows opcodes: a pickle taken apart, its opcodes moved, doubled, spliced, their arguments changed."""

from __future__ import annotations

import pickletools
from random import Random

from tests.core.importing.fuzzing.byte_mutations import NUMBERS, little
from tests.core.importing.fuzzing.pickle_grammar import Grammar

_LENGTHS = dict.fromkeys((b"\x8c", b"C", b"\x8a", b"h", b"q"), 1) | dict.fromkeys((b"\x8d", b"\x8e", b"\x95"), 8)
_LENGTHS |= dict.fromkeys((b"X", b"B", b"\x8b", b"j", b"r", b"J"), 4)
"""Width of the length, index or number that an opcode begins with."""


def opcodes_of(pickle: bytes) -> list[bytes]:
    """A sound pickle's opcodes, one after the other, with their arguments."""
    starts = [position for _, _, position in pickletools.genops(pickle) if position is not None]
    return [pickle[start:end] for start, end in zip(starts, [*starts[1:], len(pickle)], strict=True)]


def respelt(random: Random, opcodes: list[bytes], others: list[bytes]) -> bytes:
    """The pickle after one to four changes."""
    opcodes = list(opcodes)
    for _ in range(random.choice((1, 1, 2, 4))):
        at = random.randrange(1, len(opcodes)) if len(opcodes) > 1 else 0
        opcodes[at : at + 1] = _changed(random, opcodes, at, others)
    return b"".join(opcodes)


def _changed(random: Random, opcodes: list[bytes], at: int, others: list[bytes]) -> list[bytes]:
    here = opcodes[at] if opcodes else b""
    match random.randrange(8):
        case 0:
            return []
        case 1:
            return [here] * random.choice((2, 3, 300))
        case 2:
            return [random.choice(opcodes), here]
        case 3:
            start = random.randrange(len(others))
            return [*others[start : start + random.randrange(1, 30)], here]
        case 4:
            return [Grammar(random).value(3)]
        case 5:
            return [Grammar(random).value(2), b"0", here]
        case 6 if here[:1] in _LENGTHS:
            width = _LENGTHS[here[:1]]
            value = random.choice((*NUMBERS, len(here), len(here) - 1))
            return [here[:1] + little(value, width) + here[1 + width :]]
        case _:
            return [bytes([random.randrange(256)]) + here[1:]]
