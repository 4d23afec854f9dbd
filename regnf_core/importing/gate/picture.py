"""The picture that an import may write beside the field. It is checked byte by byte before it is shown."""

from __future__ import annotations

import stat
import zlib
from pathlib import Path

PICTURE_NAME = "preview.png"
"""The name of the picture in the output folder."""

CANDIDATE_BYTES = 512 << 10
"""A small picture has no more, whatever it shows."""

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_MAX_BYTES = 4 << 20
_MAX_EDGE = 4096
_TRUE_COLOR = b"\x08\x02\x00\x00\x00"
"""Eight bits a channel, red, green and blue, not interlaced."""


def candidate_name(number: int) -> str:
    """The name of the picture of the ``number``-th function that a file may stand for, counted from 1."""
    return f"candidate-{number}.png"


def is_sound_picture(path: Path, most_bytes: int = _MAX_BYTES) -> bool:
    """Whether ``path`` is a plain file of its own (no link) that holds a PNG of a header and pixels, nothing else."""
    try:
        found = path.lstat()
        if not stat.S_ISREG(found.st_mode) or found.st_nlink != 1 or not 0 < found.st_size <= most_bytes:
            return False
        return _holds_pixels_alone(path.read_bytes())
    except OSError:
        return False


def _holds_pixels_alone(data: bytes) -> bool:
    if not data.startswith(_SIGNATURE):
        return False
    at, kinds = len(_SIGNATURE), []
    while at + 12 <= len(data):
        length, kind = int.from_bytes(data[at : at + 4], "big"), data[at + 4 : at + 8]
        body, check = data[at + 8 : at + 8 + length], data[at + 8 + length : at + 12 + length]
        if len(check) != 4 or zlib.crc32(kind + body).to_bytes(4, "big") != check:
            return False
        if kind == b"IHDR" and not _is_header(body):
            return False
        kinds.append(kind)
        at += 12 + length
    pixels = set(kinds[1:-1])
    return at == len(data) and kinds[:1] == [b"IHDR"] and kinds[-1:] == [b"IEND"] and pixels == {b"IDAT"}


def _is_header(body: bytes) -> bool:
    width, height = int.from_bytes(body[:4], "big"), int.from_bytes(body[4:8], "big")
    return 0 < width <= _MAX_EDGE and 0 < height <= _MAX_EDGE and body[8:] == _TRUE_COLOR
