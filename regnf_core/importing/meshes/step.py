"""STEP models of CAD: their surfaces as triangles, by OpenCASCADE (the library cascadio)."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from regnf_core.importing.assumptions import SCENE
from regnf_core.importing.meshes.glb import read_glb
from regnf_core.importing.meshes.scene import in_meters, required
from regnf_core.importing.meshes.triangle_files import Geometry, Siblings, malformed

_COARSE = {"tol_linear": 1e6, "tol_angular": 3.0}
"""Millimeters and radians: as few triangles as there can be, which show how large the model is."""
_DEVIATION, _TURN = 5e-4, 0.5
"""How far a triangle may be from the surface, of the model's diagonal, and the largest angle between triangles of a
curved face, radians: whatever is finer."""
_MM = 1e3
_PREFIXES = {"$": "meter", ".MILLI.": "millimeter", ".CENTI.": "centimeter", ".MICRO.": "micrometer"}
_METRE = re.compile(rb"SI_UNIT\s*\(\s*(\.\w+\.|\$)\s*,\s*\.METRE\.")
_OTHER_LENGTH = re.compile(rb"CONVERSION_BASED_UNIT\s*\(\s*'(INCH|FOOT|YARD|MILE)'", re.IGNORECASE)


def read_step(data: memoryview, _: Siblings | None = None, node: str | None = None) -> Geometry:
    """The triangles of a STEP file, in meters, with the colors of its parts. node: the product to read.

    Raises FieldFormatError: MESH_INVALID, MESH_TOO_LARGE, FORMAT_NOT_SUPPORTED without cascadio, INVALID_DESCRIPTION.
    """
    corners = _triangles(data, node, _COARSE).vertices
    diagonal = float(np.linalg.norm(np.ptp(corners, axis=0))) if len(corners) else 0.0
    if not 0.0 < diagonal < np.inf:
        raise malformed("the STEP file has no surface")
    found = _triangles(data, node, {"tol_linear": _DEVIATION * _MM * diagonal, "tol_angular": _TURN})
    finer = f"its curved faces are triangles within {100.0 * _DEVIATION:g} % of its diagonal"
    return replace(found, assumes=(SCENE,), notes=(*found.notes, _unit(bytes(data)), finer))


def _triangles(data: memoryview, node: str | None, tolerances: dict[str, float]) -> Geometry:
    library = required("cascadio", "a STEP model of CAD")
    try:
        glb = library.to_glb_bytes(bytes(data), use_parallel=False, **tolerances)
    except (RuntimeError, ValueError) as error:
        raise malformed("the STEP file cannot be read") from error
    if not glb:
        raise malformed("the STEP file is damaged, or has no shape")
    return read_glb(memoryview(glb), node=node)


def _unit(text: bytes) -> str:
    """What is told of the unit of the lengths, which cascadio converts to meters."""
    if other := _OTHER_LENGTH.search(text):
        return in_meters(other[1].decode().lower())
    if (found := _METRE.search(text)) is None:
        return "the file states no unit: millimeter is assumed; coordinates were converted to meters"
    return in_meters(_PREFIXES.get(found[1].decode(), f"{found[1].decode().strip('.').lower()}meter"))
