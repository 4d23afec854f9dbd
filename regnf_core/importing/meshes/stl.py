"""STL, binary and text: loose triangles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from regnf_core.importing.meshes.geometry import Float64Array, Geometry, malformed, not_numbers, require_room

_COUNT_AT, _FACETS_AT, _FACET_BYTES = 80, 84, 50
_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read_stl(data: memoryview) -> Geometry:
    """The triangles of an STL file. Raises FieldFormatError: MESH_INVALID, MESH_TOO_LARGE."""
    count = int.from_bytes(data[_COUNT_AT:_FACETS_AT], "little")
    behind = len(data) - (_FACETS_AT + _FACET_BYTES * count)
    text = bytes(data).lstrip(b"\xef\xbb\xbf \t\r\n")
    is_text = text[:5].lower() == b"solid"
    if len(data) >= _FACETS_AT and (behind == 0 or (behind > 0 and not is_text)):
        require_room(3 * count, count)
        facets = np.frombuffer(data[_FACETS_AT:], dtype=_FACET, count=count)
        found = _loose(facets["corners"].reshape(-1, 3).astype(np.float64))
        return replace(found, left_out=(f"{behind} bytes behind the triangles",)) if behind else found
    if not is_text:
        raise malformed(f"the STL file ends within its {count} facets")
    return _loose(_corners_of_text(text.partition(b"\n")[2] if b"\n" in text else text))  # its name may say `vertex`


def _corners_of_text(text: bytes) -> Float64Array:
    words = text.split()
    at = [i for i, word in enumerate(words) if word.lower() == b"vertex"]
    require_room(len(at), len(at) // 3)
    try:
        return np.array([[float(word) for word in words[i + 1 : i + 4]] for i in at], dtype=np.float64).reshape(-1, 3)
    except ValueError as error:
        raise not_numbers("an STL vertex is not three numbers", text) from error


def _loose(corners: Float64Array) -> Geometry:
    if len(corners) % 3:
        raise malformed("an STL facet without three vertices")
    return Geometry(corners, np.arange(len(corners), dtype=np.int64).reshape(-1, 3))
