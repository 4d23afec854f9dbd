"""Numbers and texts as programs write them, made plain. Imports the standard library alone."""

from __future__ import annotations

import codecs
import re

BLANK = b"\xef\xbb\xbf \t\r\n"
"""What may stand before the first statement: a byte-order mark, blanks, ends of lines."""
_ENDED = b"\0\x1a"
"""What some disks and editors leave behind the last one."""
codecs.lookup("utf-16")  # now: the import's process may load no module once it is confined
_LOOKED_AT = 4096
_WIDE = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
_ODD = re.compile(
    rb"[-+]?(?:\d\.#(?:INF|IND|[QS]NAN)\w*|nan\(\w*\))|\xef\xbb\xbf|(?<=\d)[dD](?=[-+]?\d)", re.IGNORECASE
)
"""Numbers that are none, as Microsoft's C library writes them; marks of joined files; Fortran's exponents."""


def unmarked(text: bytes) -> bytes:
    """Without a mark and blanks at the beginning; UTF-16 that has a mark becomes UTF-8."""
    if text.startswith(_WIDE):
        text = text[: len(text) & ~1].decode("utf-16", "replace").encode()
    return text.lstrip(BLANK)


def text_alone(text: bytes) -> bytes:
    """Also without the zeros, or the sign for its end, behind a text."""
    return unmarked(text).rstrip(_ENDED)


def without_marks(data: memoryview, is_text: bool) -> memoryview:
    """The same of a whole file; only one in UTF-16 is copied. is_text: to its end."""
    head, tail = bytes(data[:_LOOKED_AT]), bytes(data[-_LOOKED_AT:])
    if head.startswith(_WIDE):
        return memoryview(text_alone(bytes(data)))
    behind = len(tail) - len(tail.rstrip(_ENDED)) if is_text else 0
    return data[len(head) - len(head.lstrip(BLANK)) : len(data) - behind]


def plain_numbers(text: bytes) -> bytes:
    """With numbers that ``float`` reads; other words stay."""
    return _ODD.sub(lambda odd: b"e" if odd[0] in b"dD" else b" " if odd[0] == b"\xef\xbb\xbf" else b"nan", text)


def number(word: bytes) -> float:
    """Raises ValueError."""
    try:
        return float(word)
    except ValueError:
        return float(plain_numbers(word))


def is_number(word: bytes) -> bool:
    try:
        number(word)
    except ValueError:
        return False
    return True
