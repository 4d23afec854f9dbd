"""OpenEXR images of one plane of depths, as Blender, Record3D and Unity write them.

The format: https://openexr.com/en/latest/OpenEXRFileLayout.html. Scan lines, uncompressed or by zip.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_MAGIC = b"\x76\x2f\x31\x01"
_TYPES = ("<u4", "<f2", "<f4")
_LINES = {0: 1, 2: 1, 3: 16}
"""Lines of a block, by the compression: none, a line by zip, 16 lines by zip."""
_DEPTHS = ("Z", "V", "R", "Y")
"""How names of a channel of depths end, the surest first."""
_OTHER_KINDS = 0x1A00
"""Tiles, deep data, several images in one file."""
_HEADER_BYTES = 1 << 20


def exr_header(path: Path) -> tuple[dict[str, bytes], int]:
    """The attributes, and where they end. Raises ValueError."""
    with path.open("rb") as file:
        data = file.read(_HEADER_BYTES)
    if data[:4] != _MAGIC or struct.unpack_from("<I", data, 4)[0] & _OTHER_KINDS:
        raise ValueError("an OpenEXR file of one image in scan lines is expected")
    found, at = {}, 8
    while data[at : at + 1] not in (b"\0", b""):
        name, kind = data.index(b"\0", at), data.index(b"\0", data.index(b"\0", at) + 1)
        (size,) = struct.unpack_from("<i", data, kind + 1)
        found[data[at:name].decode("latin-1")] = data[kind + 5 : kind + 5 + size]
        at = kind + 5 + max(size, 0)
    return found, at + 1


def exr_size(path: Path) -> tuple[int, int]:
    """Height and width. Raises ValueError."""
    left, top, right, bottom = struct.unpack("<4i", exr_header(path)[0].get("dataWindow", b""))
    if not (left <= right and top <= bottom):
        raise ValueError("its data window is empty")
    return bottom - top + 1, right - left + 1


def read_exr(path: Path) -> NDArray[Any]:
    """(H, W): the depths. Raises ValueError, struct.error, zlib.error."""
    attributes, at = exr_header(path)
    (height, width), compression = exr_size(path), attributes["compression"][0]
    if compression not in _LINES:
        raise ValueError("its compression is not supported: write it with ZIP or without compression")
    channels, rest = [], attributes["channels"]
    while rest[:1] not in (b"\0", b""):
        name, _, rest = rest.partition(b"\0")
        channels.append((name.decode("latin-1"), np.dtype(_TYPES[rest[0]])))
        rest = rest[16:]
    names = [name for name, _ in channels]
    wanted = next((one for end in _DEPTHS for one in names if one.split(".")[-1] == end), names[0])
    line = width * sum(kind.itemsize for _, kind in channels)
    before = width * sum(kind.itemsize for _, kind in channels[: names.index(wanted)])
    kind, data = dict(channels)[wanted], path.read_bytes()
    count = -(-height // _LINES[compression])
    rows = []
    for block, start in enumerate(struct.unpack_from(f"<{count}Q", data, at)):
        (size,) = struct.unpack_from("<i", data, start + 4)
        lines = min(_LINES[compression], height - block * _LINES[compression])
        raw = data[start + 8 : start + 8 + size]
        if size < lines * line:  # differences of neighboring bytes, the even ones first
            packed = np.frombuffer(zlib.decompressobj().decompress(raw, lines * line), np.uint8).copy()
            packed[1:] -= 128
            raw = np.cumsum(packed, dtype=np.uint8).reshape(2, -1).T.tobytes()
        rows += [np.frombuffer(raw, kind, width, row * line + before) for row in range(lines)]
    return np.stack(rows)
