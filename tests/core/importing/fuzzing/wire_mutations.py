"""Protocol buffers changed field by field, with lengths that fit; needs no schema."""

from __future__ import annotations

from random import Random

from tests.core.importing.fuzzing.byte_mutations import NUMBERS, damaged, rearranged

_VARINT, _WIDE, _BYTES, _NARROW = 0, 1, 2, 5
_NAMES = (b"", b"x", b"y", b"Loop", b"If", b"Scan", b"Gemm", b"Reshape", b"Expand", b"ConstantOfShape", b"../weights")

Field = tuple[int, int, int | bytes]
"""Number, wire type, value."""


def rewired(random: Random, message: bytes, depth: int = 6) -> bytes:
    """The message after one to three changes to its fields, at any depth."""
    for _ in range(random.choice((1, 1, 2, 3)) if depth == 6 else 1):
        fields = _fields(message)
        if not fields:
            return damaged(random, message)
        message = b"".join(map(_spelled, rearranged(random, fields, fields, lambda field: _odd(random, field, depth))))
    return message


def _odd(random: Random, field: Field, depth: int) -> Field:
    key, wire, value = field
    if isinstance(value, int):
        return key, wire, random.choice((*range(12), *NUMBERS, value + 1, (1 << 64) - 1))
    if depth and wire == _BYTES and random.random() < 0.8 and _fields(value):
        return key, wire, rewired(random, value, depth - 1)
    if random.random() < 0.15:
        return random.choice((1, 2, 3, 4, 5, 7, 8, 13, 14, 20, 1 << 28)), wire, value
    odd = (damaged(random, value), random.choice(_NAMES), value * 2, value[:-1], bytes(len(value)))
    return key, wire, random.choice(odd)


def _fields(message: bytes) -> list[Field]:
    """The fields, none if the bytes are no message."""
    fields: list[Field] = []
    at = 0
    try:
        while at < len(message):
            tag, at = _varint(message, at)
            key, wire = tag >> 3, tag & 7
            if wire == _VARINT:
                value, at = _varint(message, at)
                fields.append((key, wire, value))
                continue
            length, at = _varint(message, at) if wire == _BYTES else ({_WIDE: 8, _NARROW: 4}[wire], at)
            if key == 0 or at + length > len(message):
                return []
            fields.append((key, wire, message[at : at + length]))
            at += length
    except (IndexError, KeyError):
        return []
    return fields


def _varint(message: bytes, at: int) -> tuple[int, int]:
    """The number at ``at``, and where the next thing begins. Raises IndexError beyond the end."""
    value = shift = 0
    while message[at] & 0x80:
        value |= (message[at] & 0x7F) << shift
        at, shift = at + 1, shift + 7
    return value | message[at] << shift, at + 1


def _spelled(field: Field) -> bytes:
    key, wire, value = field
    tag = _number(key << 3 | wire)
    if isinstance(value, int):
        return tag + _number(value)
    return tag + (_number(len(value)) if wire == _BYTES else b"") + value


def _number(value: int) -> bytes:
    digits = bytearray()
    while value >= 0x80:
        digits.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*digits, value])
