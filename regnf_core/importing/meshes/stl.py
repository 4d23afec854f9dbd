"""STL, binary and text: loose triangles."""

from __future__ import annotations

import numpy as np

from regnf_core.importing.meshes.geometry import Float64Array, Geometry, malformed, require_room

_COUNT_AT, _FACETS_AT, _FACET_BYTES = 80, 84, 50
_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read_stl(data: memoryview) -> Geometry:
    """The triangles of an STL file. Raises FieldFormatError: MESH_INVALID, MESH_TOO_LARGE."""
    count = int.from_bytes(data[_COUNT_AT:_FACETS_AT], "little")
    if len(data) >= _FACETS_AT and len(data) == _FACETS_AT + _FACET_BYTES * count:
        require_room(3 * count, count)
        return _loose(np.frombuffer(data[_FACETS_AT:], dtype=_FACET)["corners"].reshape(-1, 3).astype(np.float64))
    text = bytes(data).lstrip(b"\xef\xbb\xbf \t\r\n")
    if text[:5].lower() != b"solid":
        raise malformed(f"an STL file of {count} facets has another length")
    return _loose(_corners_of_text(text.partition(b"\n")[2] if b"\n" in text else text))  # its name may say `vertex`


def _corners_of_text(text: bytes) -> Float64Array:
    words = text.split()
    at = [i for i, word in enumerate(words) if word.lower() == b"vertex"]
    require_room(len(at), len(at) // 3)
    try:
        return np.array([[float(word) for word in words[i + 1 : i + 4]] for i in at], dtype=np.float64).reshape(-1, 3)
    except ValueError as error:
        raise malformed("an STL vertex is not three numbers") from error


def _loose(corners: Float64Array) -> Geometry:
    if len(corners) % 3:
        raise malformed("an STL facet without three vertices")
    return Geometry(corners, np.arange(len(corners), dtype=np.int64).reshape(-1, 3))
