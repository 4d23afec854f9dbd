"""Strict readers of mesh files: numbers alone, from the bytes given. None opens another file or inflates anything but
the points of a compressed PCD file, to exactly the size that its header says."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from regnf_core.importing.meshes.e57 import read_e57
from regnf_core.importing.meshes.glb import read_glb, read_gltf
from regnf_core.importing.meshes.las import read_las
from regnf_core.importing.meshes.ply import read_ply
from regnf_core.importing.meshes.point_files import read_npy, read_pcd, read_xyz
from regnf_core.importing.meshes.triangle_files import Geometry, Siblings, read_obj, read_stl

CLOUD_FORMATS = ("ply", "pcd", "xyz", "las", "npy", "e57")
"""Formats that may hold points alone."""
_IN_PARTS: dict[str, Callable[[memoryview, Siblings], Geometry]] = {"glb": read_glb, "gltf": read_gltf}
_WHOLE: dict[str, Callable[[memoryview], Geometry]] = {
    "las": read_las,
    "npy": read_npy,
    "obj": read_obj,
    "pcd": read_pcd,
    "ply": read_ply,
    "stl": read_stl,
    "xyz": read_xyz,
}
_AT_FIXED_BYTES = frozenset({"glb", "las", "npy", "stl"})
_BLANK, _MOST_BLANKS = b"\xef\xbb\xbf \t\r\n", 4096
MESH_READERS = (*_WHOLE, *_IN_PARTS, "e57")
"""The names that ``sniff_format`` gives files with a reader here."""


def read_mesh(format_: str, data: memoryview, siblings: Siblings | None = None, path: Path | None = None) -> Geometry:
    """What a file of this format holds. ``siblings``: the files that came with it in one archive, by relative name.
    path: where the bytes are; E57 is read from there.

    Raises FieldFormatError: MESH_INVALID, MESH_TOO_LARGE, MESH_EXTERNAL_REFERENCE, FORMAT_NOT_SUPPORTED.
    """
    if format_ == "e57":
        if path is None:
            raise ValueError("an E57 file is read from its path")
        return read_e57(path)
    if format_ not in _AT_FIXED_BYTES:  # text may begin with a byte-order mark and blank lines
        head = bytes(data[:_MOST_BLANKS])
        data = data[len(head) - len(head.lstrip(_BLANK)) :]
    if format_ in _IN_PARTS:
        return _IN_PARTS[format_](data, siblings or {})
    return _WHOLE[format_](data)
