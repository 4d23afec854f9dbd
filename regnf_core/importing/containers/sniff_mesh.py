"""Whether a file's first bytes are those of a mesh. Some formats have no magic number: their content decides."""

from __future__ import annotations

import math
import re
import struct

MESH_FORMATS = ("dae", "glb", "gltf", "obj", "off", "pcd", "ply", "stl", "xyz")

HEAD_BYTES = 4096
"""How many first bytes are enough to name every format: licences and names may come first."""
_MARK = b"\xef\xbb\xbf"
"""Of UTF-8, as Windows writes it before a text."""
_BLANK = b"\xef\xbb\xbf \t\r\n"
_OFF = re.compile(rb"(ST)?C?N?4?n?OFF(?![A-Za-z])")
_GLTF_WORDS = (b'"asset"', b'"accessors"', b'"bufferViews"')
_STL_FACETS_AT, _STL_FACET_BYTES = 84, 50
_MAX_STL_FACETS = 1 << 26
_OBJ_NUMBERS = {b"v": 3, b"vn": 3, b"vt": 1}
_OBJ_WORDS = frozenset(
    b"o g s mtllib usemtl usemap maplib mg vp cstype deg bmat step curv curv2 surf parm lod bevel c_interp d_interp"
    b" shadow_obj trace_obj".split()
)
"""Statements that may stand before the first vertex, with or without a name behind them."""
_CONTROL = frozenset(range(32)) - frozenset(b"\t\n\v\f\r")


def sniff_mesh(head: bytes) -> str | None:
    """One of MESH_FORMATS, or None. ``head``: the file's first HEAD_BYTES, or all of it."""
    head = head.removeprefix(_MARK)
    if head.startswith((b"ply\n", b"ply\r")):
        return "ply"
    if head.startswith(b"glTF"):
        return "glb"
    if _OFF.match(head):
        return "off"
    if b"<COLLADA" in head and head.lstrip(_BLANK).startswith(b"<"):
        return "dae"
    if head.lstrip(_BLANK).startswith(b"{") and any(word in head for word in _GLTF_WORDS):
        return "gltf"
    if _is_pcd(head):
        return "pcd"
    if _is_stl_text(head):
        return "stl"
    if _is_obj(head):
        return "obj"
    if _is_binary_stl(head):
        return "stl"
    return "xyz" if _is_xyz(head) else None


def _is_pcd(head: bytes) -> bool:
    """Text whose first line that is not a comment names a version, and then the fields of a point."""
    lines = [line.split() for line in head.splitlines() if line.strip() and not line.startswith(b"#")]
    named = head.startswith(b"# .PCD") or bool(lines and lines[0][:1] == [b"VERSION"])
    return named and any(words[:1] == [b"FIELDS"] for words in lines)


def _is_xyz(head: bytes) -> bool:
    """Lines of as many numbers each, three at least; the first may be their count alone, the last is cut off."""
    if _CONTROL & set(head):
        return False
    lines = head.splitlines()
    if len(head) >= HEAD_BYTES and not head.endswith(b"\n"):
        lines = lines[:-1]
    said = [line.replace(b",", b" ").replace(b";", b" ").split() for line in lines]
    said = [words for words in said if words and not words[0].startswith((b"#", b"//"))]
    if said and len(said[0]) == 1 and said[0][0].isdigit():
        said = said[1:]
    return bool(said) and len(said[0]) >= 3 and all(len(w) == len(said[0]) and all(map(_is_number, w)) for w in said)


def _is_stl_text(head: bytes) -> bool:
    """A solid, whatever it is called, and then its facets, or its end."""
    text = head.lstrip().lower()
    if not text.startswith(b"solid") or _CONTROL & set(head):
        return False
    return b"facet" in text or b"endsolid" in text or (len(head) >= HEAD_BYTES and b"\n" not in text.strip())


def _is_obj(head: bytes) -> bool:
    """Text whose lines, up to the first vertex, say what a line of an OBJ file may say."""
    if _CONTROL & set(head):
        return False
    lines = [line.split() for line in head.splitlines() if line.strip()]
    said = [words for words in lines if not words[0].startswith(b"#")]
    if not said:
        return b"obj" in head.lower() and head.startswith(b"#")
    for first, *rest in said:
        if first in _OBJ_NUMBERS:
            return len(rest) >= _OBJ_NUMBERS[first] and all(map(_is_number, rest))
        if first not in _OBJ_WORDS:
            return False
    return True


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
