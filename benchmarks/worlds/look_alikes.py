"""Objects that differ from the right one by a part: one that is missing, or one more."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from benchmarks.random_worlds.mesh import Array, Mesh, block, together
from benchmarks.worlds.cases import WorldCase
from benchmarks.worlds.making import WORLD, read_object_mesh
from regnf_core import Sim3
from regnf_core.fields.mesh import MeshField

LOOK_ALIKE = "look-alike"
_PART = (0.03, 0.4)
"""Shares of the surface that a missing part may have."""
_SIZES = (0.12, 0.3)
"""Edges of an additional block, diameters."""
_DIFFERS = 0.05
"""Diameters that the part reaches beyond the rest, at least."""
_POINTS = 4000


def look_alike(home: Path, known: WorldCase, rng: np.random.Generator) -> WorldCase:
    """The case with another object in place of the right one. home: the world's folder."""
    number = known.facts["case"]
    mesh = read_object_mesh(home, number)
    altered = _without_a_part(mesh, rng) if rng.random() < 0.5 else None
    altered = altered or _with_a_block(mesh, rng)
    T_object_model = Sim3.from_matrix(json.loads((home / WORLD).read_text())["cases"][number]["T_object_model"])
    field = MeshField(altered.vertices, altered.faces).transformed(T_object_model.matrix().numpy())
    points = T_object_model.apply(torch.from_numpy(altered.sample(_POINTS, rng)[0]))
    facts = {**known.facts, "object": LOOK_ALIKE}
    return replace(known, case=replace(known.case, obj=field), facts=facts, points=points)


def _without_a_part(mesh: Mesh, rng: np.random.Generator) -> Mesh | None:
    """Without one of the pieces that the mesh consists of; None where it has no suitable one."""
    _, same = np.unique(mesh.vertices.round(6), axis=0, return_inverse=True)
    faces = same.ravel()[mesh.faces]
    ends = np.concatenate([faces[:, :2], faces[:, 1:]])
    count = int(same.max()) + 1
    _, piece = connected_components(coo_array((np.ones(len(ends)), tuple(ends.T)), shape=(count, count)))
    of_face = piece[faces[:, 0]]
    areas = mesh.normals_and_areas[1]
    for number in rng.permutation(np.unique(of_face)):
        share = areas[of_face == number].sum() / areas.sum()
        rest, part = mesh.faces[of_face != number], mesh.faces[of_face == number]
        if _PART[0] <= share <= _PART[1] and _reach(mesh, part, rest) >= _DIFFERS:
            return Mesh(mesh.vertices, rest)
    return None


def _reach(mesh: Mesh, part: Array, rest: Array) -> float:
    """How far the part's vertices lie from the rest, diameters."""
    field = MeshField(mesh.vertices, rest)
    corners = torch.from_numpy(mesh.vertices[np.unique(part)])
    return float(field.signed_distance(corners).max()) / float(np.linalg.norm(mesh.size))


def _with_a_block(mesh: Mesh, rng: np.random.Generator) -> Mesh:
    """With a block half outside of it, somewhere on its surface."""
    points, normals = mesh.sample(64, rng)
    size = rng.uniform(*_SIZES, 3) * float(np.linalg.norm(mesh.size))
    center = points[0] + 0.25 * size.min() * normals[0]
    return together(mesh, block(center.tolist(), size.tolist()))
