"""Strict readers of mesh files: numbers alone, from the bytes given. None opens another file or inflates anything."""

from __future__ import annotations

from collections.abc import Callable

from regnf_core.importing.meshes.geometry import Geometry
from regnf_core.importing.meshes.glb import read_glb
from regnf_core.importing.meshes.obj import read_obj
from regnf_core.importing.meshes.ply import read_ply
from regnf_core.importing.meshes.stl import read_stl

MESH_READERS: dict[str, Callable[[memoryview], Geometry]] = {
    "glb": read_glb,
    "obj": read_obj,
    "ply": read_ply,
    "stl": read_stl,
}
"""By the name that ``sniff_format`` gives the file."""
