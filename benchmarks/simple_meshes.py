"""Closed triangle meshes of simple solids: boxes, prisms and solids of revolution."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from regnf_core.fields.mesh import MeshField

_BOX_FACES = (
    (0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
    (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3),
)  # fmt: skip


def box(lower: Sequence[float], upper: Sequence[float]) -> MeshField:
    """The box between two corners (3,)."""
    corners = np.array([lower, upper], dtype=np.float64)
    bits = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)])
    return MeshField(corners[bits, np.arange(3)], np.array(_BOX_FACES))


def revolved(profile: Sequence[tuple[float, float]], sides: int = 48) -> MeshField:
    """The solid that a profile of (radius, height) points, from the axis below to the axis above, makes about z."""
    radius, height = np.array(profile, dtype=np.float64).T
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)  # (sides, 2)
    vertices: NDArray[Any] = np.concatenate(
        [np.concatenate([r * ring, np.full((sides, 1), z)], axis=1) for r, z in zip(radius, height, strict=True)]
    )
    faces = []
    for level in range(len(profile) - 1):
        for i in range(sides):
            a, b = level * sides + i, level * sides + (i + 1) % sides
            faces += [(a, b, b + sides), (a, b + sides, a + sides)]
    return MeshField(vertices, faces)


def together(*parts: MeshField) -> MeshField:
    """All parts as one mesh; the winding number makes of overlapping closed parts their union."""
    counts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, counts, strict=False)])
    return MeshField(vertices, faces)
