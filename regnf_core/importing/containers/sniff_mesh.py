"""Whether a file's first bytes are those of a mesh. Two formats have no magic number: their content decides."""

from __future__ import annotations

import math
import struct

MESH_FORMATS = ("glb", "obj", "ply", "stl")

_STL_FACETS_AT, _STL_FACET_BYTES = 84, 50
_MAX_STL_FACETS = 1 << 26
_OBJ_NUMBERS = {b"v": 3, b"vn": 3, b"vt": 1}
_OBJ_WORDS = (b"o", b"g", b"mtllib", b"usemtl", b"s")
_CONTROL = frozenset(range(32)) - frozenset(b"\t\n\v\f\r")


def sniff_mesh(head: bytes) -> str | None:
    """``"ply"``, ``"glb"``, ``"stl"`` or ``"obj"``, or None. ``head``: the file's first 512 bytes, or all of it."""
    if head.startswith((b"ply\n", b"ply\r")):
        return "ply"
    if head.startswith(b"glTF"):
        return "glb"
    if head.startswith(b"solid") and b"facet" in head:
        return "stl"
    if _is_obj(head):
        return "obj"
    return "stl" if _is_binary_stl(head) else None


def _is_obj(head: bytes) -> bool:
    """Text whose first line that is not a comment says what a line of an OBJ file may say."""
    if _CONTROL & set(head):
        return False
    lines = [line.split() for line in head.splitlines() if line.strip()]
    said = [words for words in lines if not words[0].startswith(b"#")]
    if not said:
        return b"obj" in head.lower() and head.startswith(b"#")
    first, *rest = said[0]
    if first in _OBJ_NUMBERS:
        return len(rest) >= _OBJ_NUMBERS[first] and all(map(_is_number, rest))
    return first in _OBJ_WORDS and len(rest) >= 1


def _is_number(word: bytes) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _is_binary_stl(head: bytes) -> bool:
    """Facets whose corners are ordinary numbers and whose normals have length one, or none at all."""
    facets = (len(head) - _STL_FACETS_AT) // _STL_FACET_BYTES
    claimed = int.from_bytes(head[80:84], "little")
    if facets < 1 or not facets <= claimed <= _MAX_STL_FACETS:
        return False
    for number in range(facets):
        values = struct.unpack_from("<12f", head, _STL_FACETS_AT + _STL_FACET_BYTES * number)
        if not all(math.isfinite(value) and abs(value) < 1e9 for value in values):
            return False
        length = math.hypot(*values[:3])
        if not (length < 1e-6 or abs(length - 1.0) < 0.05):
            return False
        if all(abs(value) < 1e-30 for value in values[3:]):
            return False
    return True
