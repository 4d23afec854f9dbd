"""Strict readers of mesh files: numbers alone, from the bytes given. None opens another file or inflates anything but
the points of a compressed PCD file and the parts of a 3MF package, to exactly the size that their headers say. STEP,
USD and Draco are read by libraries, which an optional extra brings."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from regnf_core.importing.containers.plain_text import without_marks
from regnf_core.importing.meshes.e57 import read_e57
from regnf_core.importing.meshes.glb import read_glb, read_gltf
from regnf_core.importing.meshes.las import read_las
from regnf_core.importing.meshes.ply import read_ply
from regnf_core.importing.meshes.point_files import read_npy, read_pcd, read_xyz
from regnf_core.importing.meshes.scene import refuse_node
from regnf_core.importing.meshes.step import read_step
from regnf_core.importing.meshes.threemf import read_3mf
from regnf_core.importing.meshes.triangle_files import Geometry, Siblings, read_obj, read_stl
from regnf_core.importing.meshes.urdf import read_urdf
from regnf_core.importing.meshes.usd import read_usd

CLOUD_FORMATS = ("ply", "pcd", "xyz", "las", "npy", "e57", "obj")
"""Formats that may hold points alone."""
_OF_NODES: dict[str, Callable[[memoryview, Siblings, str | None], Geometry]] = {
    "3mf": read_3mf,
    "glb": read_glb,
    "gltf": read_gltf,
    "step": read_step,
    "urdf": lambda data, siblings, node: read_urdf(data, siblings, node, read_mesh),
    "usd": read_usd,
}
_WHOLE: dict[str, Callable[[memoryview], Geometry]] = {
    "las": read_las,
    "npy": read_npy,
    "obj": read_obj,
    "pcd": read_pcd,
    "ply": read_ply,
    "stl": read_stl,
    "xyz": read_xyz,
}
_AT_FIXED_BYTES = frozenset({"3mf", "glb", "las", "npy", "stl", "usd"})
_TEXTS = frozenset({"gltf", "obj", "urdf", "xyz"})
MESH_READERS = (*_WHOLE, *_OF_NODES, "e57")
"""The names that ``sniff_format`` gives files with a reader here."""


def read_mesh(
    format_: str,
    data: memoryview,
    siblings: Siblings | None = None,
    node: str | None = None,
    path: Path | None = None,
) -> Geometry:
    """What a file of this format holds. ``siblings``: the files that came with it in one archive, by relative name ·
    node: of a scene, the node to read · path: where the bytes are; E57 is read from there.

    Raises FieldFormatError: MESH_INVALID, MESH_TOO_LARGE, MESH_EXTERNAL_REFERENCE, FORMAT_NOT_SUPPORTED; and
    INVALID_DESCRIPTION for a node that is not there.
    """
    if format_ == "e57":
        if path is None:
            raise ValueError("an E57 file is read from its path")
        return read_e57(path)
    if format_ not in _AT_FIXED_BYTES:
        data = without_marks(data, format_ in _TEXTS)
    if format_ in _OF_NODES:
        return _OF_NODES[format_](data, siblings or {}, node)
    refuse_node(node, format_)
    return _WHOLE[format_](data)
