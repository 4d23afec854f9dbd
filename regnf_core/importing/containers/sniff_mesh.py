"""Whether a file's first bytes are those of a mesh. Some formats have no magic number: their content decides."""

from __future__ import annotations

import math
import re
import struct

MESH_FORMATS = ("dae", "glb", "gltf", "obj", "off", "pcd", "ply", "stl", "xyz")

_BLANK = b"\xef\xbb\xbf \t\r\n"
_OFF = re.compile(rb"(?:#[^\n]*\n\s*)*(ST)?C?N?4?n?OFF(?![A-Za-z])")
_GLTF_WORDS = (b'"asset"', b'"accessors"', b'"bufferViews"')
_STL_FACETS_AT, _STL_FACET_BYTES = 84, 50
_MAX_STL_FACETS = 1 << 26
_OBJ_NUMBERS = {b"v": 3, b"vn": 3, b"vt": 1}
_OBJ_WORDS = frozenset(
    b"v vt vn vp f l p o g s mg mtllib usemtl usemap maplib lod bevel c_interp d_interp shadow_obj trace_obj "
    b"cstype deg bmat step curv curv2 surf parm trim hole scrv sp end con ctech stech call csh".split()
)
"""The statements of the format's specification."""
_OBJ_FEW = 8
"""Statements that decide: by then every writer has written one that no other text begins with."""
_LONG_COMMENT = 2048
"""Bytes of comments, and nothing else, before the first statement: of the formats taken only OBJ has such."""
_CONTROL = frozenset(range(32)) - frozenset(b"\t\n\v\f\r")


def sniff_mesh(head: bytes) -> str | None:
    """One of MESH_FORMATS, or None. ``head``: the file's beginning, HEAD_BYTES of it or the whole file.

    Text may begin with a byte-order mark, blank lines and comments: the first statement decides, wherever it stands.
    """
    if head.startswith(b"glTF"):
        return "glb"
    if _is_binary_stl(head):
        return "stl"
    text = head.lstrip(_BLANK)
    if re.match(rb"ply[ \t]*[\r\n]", text):
        return "ply"
    if _OFF.match(text):
        return "off"
    if b"<COLLADA" in text and text.startswith(b"<"):
        return "dae"
    if text.startswith(b"{") and any(word in text for word in _GLTF_WORDS):
        return "gltf"
    if _is_pcd(text):
        return "pcd"
    if text[:5].lower() == b"solid" and (b"facet" in text.lower() or not _CONTROL & set(text)):
        return "stl"
    if _is_obj(text):
        return "obj"
    return "xyz" if _is_xyz(text) else None


def _statements(text: bytes, comments: tuple[bytes, ...]) -> list[list[bytes]]:
    """The words of each line that is no comment. A last line without an end may be cut off: it does not count, unless
    it is the only one."""
    lines = text.splitlines()
    if len(lines) > 1 and not text.endswith((b"\n", b"\r")):
        lines = lines[:-1]
    return [line.split() for line in lines if line.strip() and not line.lstrip().startswith(comments)]


def _is_pcd(text: bytes) -> bool:
    """Its first line that is not a comment names a version, and then the fields of a point."""
    said = _statements(text, (b"#",))
    named = text.startswith(b"# .PCD") or bool(said and said[0][0] == b"VERSION")
    return named and any(words[0] == b"FIELDS" for words in said)


def _is_xyz(text: bytes) -> bool:
    """Lines of as many numbers each, three at least; the first may be their count alone."""
    if _CONTROL & set(text):
        return False
    said = _statements(text.replace(b",", b" ").replace(b";", b" "), (b"#", b"//"))
    if said and len(said[0]) == 1 and said[0][0].isdigit():
        said = said[1:]
    return bool(said) and len(said[0]) >= 3 and all(len(w) == len(said[0]) and all(map(_is_number, w)) for w in said)


def _is_obj(text: bytes) -> bool:
    """Lines that begin with statements of an OBJ file, or comments alone, as far as one can see."""
    if _CONTROL & set(text):
        return False
    said = _statements(text, (b"#",))[:_OBJ_FEW]
    if not said:
        return text.startswith(b"#") and (b"obj" in text.lower() or len(text) > _LONG_COMMENT)
    if not all(words[0] in _OBJ_WORDS for words in said):
        return False
    # A single short word begins many a text: one line alone has to say all that its statement needs.
    needed = _OBJ_NUMBERS.get(said[0][0])
    if needed is not None:
        return len(said[0]) > needed and all(map(_is_number, said[0][1:]))
    return len(said) > 1 or len(said[0]) > 1


def _is_number(word: bytes) -> bool:
    """Also with a decimal comma, which the reader then names."""
    try:
        float(word.replace(b",", b"."))
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
