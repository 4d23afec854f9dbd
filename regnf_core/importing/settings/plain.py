"""What the readers of settings files give: plain values. A tag of YAML stays a text beside its value."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from regnf_core.errors import FieldFormatError
from regnf_core.texts import TextError, decode_text

MAX_DEPTH = 48
MAX_NODES = 60_000
MAX_NUMBER_CHARACTERS = 40
"""No trainer writes a longer one."""


@dataclass(frozen=True)
class Tagged:
    """A value that the file wants made into an object of ``tag``. Nothing is made: ``value`` is what was written."""

    tag: str
    value: Any


def malformed(message: str) -> FieldFormatError:
    """The error for settings that break their format."""
    return FieldFormatError(message, reason="SETTINGS_MALFORMED")


def too_large(message: str) -> FieldFormatError:
    """The error for settings beyond what any trainer writes."""
    return FieldFormatError(message, reason="SETTINGS_TOO_LARGE")


def unsafe(message: str) -> FieldFormatError:
    """The error for settings that ask for another file, or for the environment."""
    return FieldFormatError(message, reason="SETTINGS_UNSAFE")


def decoded(name: str, data: bytes | memoryview, most: int) -> str:
    """The file as text. Raises FieldFormatError: SETTINGS_TOO_LARGE, SETTINGS_MALFORMED."""
    if len(data) > most:
        raise too_large(f"{name} has {len(data)} bytes; at most {most} are read")
    try:
        return decode_text(data)
    except TextError as error:
        raise malformed(f"{name} is {error}") from error


def looks_like_json(data: bytes | memoryview) -> bool:
    """Whether a text begins with a brace, in whatever encoding."""
    return bytes(data[:64]).strip(b"\xef\xbb\xbf\xfe\xff\0 \t\r\n")[:1] == b"{"


def plain(value: Any) -> Any:
    """The value below its tags."""
    while isinstance(value, Tagged):
        value = value.value
    return value
