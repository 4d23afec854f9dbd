"""What a mesh file holds that a field needs, and the limits that all readers share."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from regnf_core.errors import FieldFormatError

Float64Array = npt.NDArray[np.float64]
Int64Array = npt.NDArray[np.int64]

Siblings = Mapping[str, memoryview]
"""The files that came with a mesh in one archive, by their names relative to it."""

MAX_TRIANGLES = 2_000_000
MAX_VERTICES = 6_000_000


@dataclass(frozen=True)
class Geometry:
    """Points, and the triangles between them; nothing of it is checked but its shapes."""

    vertices: Float64Array
    """(V, 3), the file's own frame and unit."""
    faces: Int64Array
    """(F, 3) indices; F is 0 for a point cloud."""
    normals: Float64Array | None = None
    """(V, 3), where the file has one a vertex."""
    colors: Float64Array | None = None
    """(V, 3) in [0, 1], R, G, B, where the file has one a vertex."""
    left_out: tuple[str, ...] = ()
    """What the file holds or names that was not read, a few words each: the shape is the same without."""
    not_applied: tuple[str, ...] = ()
    """The same of what changes the shape: it is warned of."""


def not_numbers(message: str, text: bytes) -> FieldFormatError:
    """The error for words that are no numbers, which says so where the reason is how decimals are written."""
    commas = re.search(rb"\d,\d", text) is not None
    return malformed(message + (": decimals have points, not commas" if commas else ""))


def malformed(message: str) -> FieldFormatError:
    """The error for a file that breaks its own format."""
    return FieldFormatError(message, reason="MESH_INVALID")


def elsewhere(message: str) -> FieldFormatError:
    """The error for a file whose geometry lies in another file, or that would have a command run."""
    return FieldFormatError(message, reason="MESH_EXTERNAL_REFERENCE")


def unsupported(message: str) -> FieldFormatError:
    """The error for a sound file that uses a part of its format which is not read here."""
    return FieldFormatError(message, reason="FORMAT_NOT_SUPPORTED")


def require_room(vertices: int, triangles: int) -> None:
    """Raise FieldFormatError (MESH_TOO_LARGE) beyond the limits. Ask before arrays of these lengths are made."""
    if vertices > MAX_VERTICES:
        raise FieldFormatError(f"{vertices} vertices, at most {MAX_VERTICES} are taken", reason="MESH_TOO_LARGE")
    if triangles > MAX_TRIANGLES:
        raise FieldFormatError(f"{triangles} triangles, at most {MAX_TRIANGLES} are taken", reason="MESH_TOO_LARGE")


def within_unit(colors: Float64Array, top: float = 1.0) -> Float64Array:
    """Colors of numbers up to ``top`` as such in [0, 1]; what is no number is black."""
    return np.nan_to_num(colors / top, nan=0.0, posinf=1.0, neginf=0.0).clip(0.0, 1.0)


def fans(polygons: npt.NDArray[Any]) -> Int64Array:
    """(F, 3) triangles from (P, n) polygons of n >= 3 corners each, as fans round their first corner."""
    corners = np.asarray(polygons, dtype=np.int64)
    parts = [corners[:, [0, i, i + 1]] for i in range(1, corners.shape[1] - 1)]
    triangles: Int64Array = np.concatenate(parts) if parts else np.zeros((0, 3), np.int64)
    return triangles


def strips(order: npt.NDArray[Any]) -> Int64Array:
    """(F, 3) triangles from corners (N,) in strips, which -1 parts; every second triangle of a strip is turned."""
    corners = np.asarray(order, dtype=np.int64)
    if len(corners) < 3:
        return np.zeros((0, 3), np.int64)
    place = np.arange(len(corners))
    begun = np.maximum.accumulate(np.where(corners == -1, place + 1, 0))
    triangles = np.stack((corners[:-2], corners[1:-1], corners[2:]), axis=1)
    turned = ((place - begun)[:-2] % 2 == 1)[:, None]
    triangles = np.where(turned, triangles[:, [1, 0, 2]], triangles)
    whole: Int64Array = triangles[(triangles != -1).all(axis=1)]
    return whole


def fan(order: npt.NDArray[Any]) -> Int64Array:
    """(N - 2, 3) triangles of corners (N,) round the first of them."""
    corners = np.asarray(order, dtype=np.int64)
    return fans(corners[None]) if len(corners) >= 3 else np.zeros((0, 3), np.int64)
