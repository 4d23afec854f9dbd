"""Other objects of a similar shape, a chair for a chair: what a detector takes for the same, and a library holds beside
the right one."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from benchmarks.random_worlds.mesh import Array, Mesh
from benchmarks.random_worlds.models import BIG_M, Catalog
from benchmarks.worlds.cases import WorldCase
from benchmarks.worlds.making import WORLD, read_object_mesh, similarity
from regnf_core import Sim3
from regnf_core.fields.mesh import MeshField

SIMILAR = "similar"
_DRAWN = 24
"""Parametric things among which the most similar one is looked for; as many more are objects of other worlds."""
_POINTS, _SURFACE = 400, 4000
_TURNS = 8
"""About the up axis, in which shapes are compared."""
_SCALES = (0.05, 20.0)


def similar_object(home: Path, known: WorldCase, others: Sequence[Path], rng: np.random.Generator) -> WorldCase:
    """The case with another object in place of the right one: the most similar one of a few dozen things.

    home: the world's folder · others: folders of worlds whose objects may stand in for it. Half of the things that are
    compared are objects of these, under other names; the rest is parametric and drawn anew. Sizes do not count, since
    a registration looks for the scale too.
    """
    right = read_object_mesh(home, known.facts["case"])
    listed = [*_of_worlds(others, known.facts["object"], rng), *_parametric(right, rng)]
    shape = _shape(right, rng)
    mesh = min(listed, key=lambda one: _difference(shape, _shape(one, rng)))
    T_object_model = Sim3.from_matrix(similarity(rng, _SCALES))
    field = MeshField(mesh.vertices, mesh.faces).transformed(T_object_model.matrix().numpy())
    points = T_object_model.apply(torch.from_numpy(mesh.sample(_SURFACE, rng)[0]))
    facts = {**known.facts, "object": SIMILAR}
    return replace(known, case=replace(known.case, obj=field), facts=facts, points=points)


def _of_worlds(homes: Sequence[Path], name: str, rng: np.random.Generator) -> Iterator[Mesh]:
    """Objects of other names, one of each name, as many as are drawn. Names that begin with one another are the same:
    they are an object and its look-alikes."""
    found = {
        case["name"]: (home, number)
        for home in homes
        for number, case in enumerate(json.loads((home / WORLD).read_text())["cases"])
    }
    names = sorted(one for one in found if not one.startswith(name) and not name.startswith(one))
    for one in rng.permutation(names)[:_DRAWN]:
        yield read_object_mesh(*found[str(one)])


def _parametric(right: Mesh, rng: np.random.Generator) -> Iterator[Mesh]:
    """Things drawn at random, furniture for furniture."""
    big = float(np.linalg.norm(right.size)) >= BIG_M
    for _ in range(_DRAWN):
        yield (Catalog().draw_big(rng) if big else Catalog().draw_small(rng)).mesh


def _shape(mesh: Mesh, rng: np.random.Generator) -> Array:
    """(N, 3) points even over the surface, the middle of their box at the origin, in lengths of its diagonal."""
    points = mesh.sample(_POINTS, rng)[0]
    low, high = points.min(axis=0), points.max(axis=0)
    return np.asarray((points - (low + high) / 2.0) / np.linalg.norm(high - low))


def _difference(a: Array, b: Array) -> float:
    """Mean distance between two shapes, either way, in the best of a few turns about the up axis."""
    of_a = KDTree(a)
    turns = (Rotation.from_euler("z", 2.0 * np.pi * step / _TURNS).apply(b) for step in range(_TURNS))
    return min(float(of_a.query(turned)[0].mean() + KDTree(turned).query(a)[0].mean()) for turned in turns)
