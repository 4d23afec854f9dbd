"""Protocol buffers on the wire: numbered fields of bytes and integers. What they mean is the caller's business."""

from __future__ import annotations

import struct

from regnf_core.errors import FieldFormatError

_VARINT, _EIGHT_BYTES, _BYTES, _FOUR_BYTES = 0, 1, 2, 5
_MAX_FIELDS = 200_000

Value = int | memoryview
Message = dict[int, list[Value]]


def malformed(message: str) -> FieldFormatError:
    """The error for bytes that are not an ONNX model."""
    return FieldFormatError(message, reason="ONNX_MALFORMED")


def read_message(data: memoryview) -> Message:
    """The fields of a message by number: whole numbers, or bytes (also for the fixed sizes), in order.

    Raises FieldFormatError (ONNX_MALFORMED).
    """
    fields: Message = {}
    at = count = 0
    while at < len(data):
        key, at = _varint(data, at)
        number, kind = key >> 3, key & 7
        count += 1
        if number == 0 or count > _MAX_FIELDS:
            raise malformed("a protocol buffer with a field zero, or with more fields than any model")
        if kind == _VARINT:
            value, at = _varint(data, at)
            fields.setdefault(number, []).append(value)
            continue
        size = {_EIGHT_BYTES: 8, _FOUR_BYTES: 4}.get(kind, -1)
        if kind == _BYTES:
            size, at = _varint(data, at)
        if size < 0 or at + size > len(data):
            raise malformed("a protocol buffer ends within a field, or has one of an unknown kind")
        fields.setdefault(number, []).append(data[at : at + size])
        at += size
    return fields


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    value = 0
    for position in range(10):
        if at + position >= len(data):
            raise malformed("a protocol buffer ends within a number")
        byte = data[at + position]
        value |= (byte & 0x7F) << (7 * position)
        if byte < 0x80:
            return value & 0xFFFF_FFFF_FFFF_FFFF, at + position + 1
    raise malformed("a protocol buffer with a number of more than ten bytes")


def messages(message: Message, number: int) -> list[memoryview]:
    """The bytes of every occurrence of field ``number``. Raises FieldFormatError (ONNX_MALFORMED)."""
    found: list[memoryview] = []
    for value in message.get(number, []):
        if isinstance(value, int):
            raise malformed(f"field {number} is a number instead of bytes")
        found.append(value)
    return found


def text(message: Message, number: int) -> str:
    """The last occurrence of a string field; "" where there is none. Raises FieldFormatError (ONNX_MALFORMED)."""
    found = messages(message, number)
    return decoded(found[-1]) if found else ""


def decoded(value: memoryview) -> str:
    """Bytes as UTF-8 text. Raises FieldFormatError (ONNX_MALFORMED)."""
    try:
        return bytes(value).decode("utf-8")
    except UnicodeDecodeError as error:
        raise malformed("a name that is not text") from error


def integers(message: Message, number: int) -> list[int]:
    """A repeated int64 field, packed or not. Raises FieldFormatError (ONNX_MALFORMED)."""
    found: list[int] = []
    for value in message.get(number, []):
        if isinstance(value, int):
            found.append(_signed(value))
            continue
        at = 0
        while at < len(value):
            one, at = _varint(value, at)
            found.append(_signed(one))
    return found


def integer(message: Message, number: int, default: int = 0) -> int:
    """The last occurrence of an int64 field."""
    found = integers(message, number)
    return found[-1] if found else default


def floats(message: Message, number: int) -> list[float]:
    """A repeated float field, packed or not. Raises FieldFormatError (ONNX_MALFORMED)."""
    raw = b"".join(bytes(value) for value in messages(message, number))
    if len(raw) % 4:
        raise malformed("a list of floats ends within a float")
    return list(struct.unpack(f"<{len(raw) // 4}f", raw))


def _signed(value: int) -> int:
    return value - (1 << 64) if value >> 63 else value
