"""Similar objects have the right object's shape, nearly, and are no copy of it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch

from benchmarks.random_worlds.mesh import Mesh, block, together
from benchmarks.robust.cases import Case
from benchmarks.worlds.cases import WorldCase
from benchmarks.worlds.making import WORLD
from benchmarks.worlds.similar_objects import SIMILAR, similar_object
from regnf_core import OrientedBox, Sim3
from regnf_core.fields.mesh import MeshField
from regnf_core.geometry.metrics import Symmetries

LEG, BRANCH = block([0.0, 0.0, 0.5], [0.1, 0.1, 1.0]), block([0.3, 0.0, 0.9], [0.5, 0.1, 0.1])
BRACKET = together(LEG, BRANCH)


def world(folder: Path, **objects: Mesh) -> Path:
    """A folder with these objects, by name."""
    folder.mkdir()
    for number, mesh in enumerate(objects.values()):
        np.savez(folder / f"object-{number}.npz", vertices=mesh.vertices, faces=mesh.faces)
    (folder / WORLD).write_text(json.dumps({"cases": [{"name": name} for name in objects]}))
    return folder


def first_case(mesh: Mesh) -> WorldCase:
    field = MeshField(mesh.vertices, mesh.faces)
    box = OrientedBox(torch.zeros(3).double(), torch.ones(3).double(), torch.eye(3).double())
    case = Case("a bracket", field, field, box, Sim3.identity())
    return WorldCase(case, {"case": 0, "object": "bracket"}, torch.zeros(0, 3), Symmetries())


def ratios(points: torch.Tensor) -> torch.Tensor:
    """(3,) standard deviations along the principal axes, of the largest; the same at any pose and scale."""
    sizes = torch.linalg.svdvals(points - points.mean(0))
    return sizes / sizes[0]


def turned_and_wider(mesh: Mesh, width: float, scale: float) -> Mesh:
    """Turned a quarter about the up axis."""
    x, y, z = mesh.vertices.T
    return Mesh(scale * np.stack([-y * width, x, z], 1), mesh.faces)


def test_the_most_similar_object_of_another_name_is_taken(tmp_path: Path) -> None:
    right = world(tmp_path / "right", bracket=BRACKET)
    wider = turned_and_wider(BRACKET, 2.0, 3.0)
    other = world(tmp_path / "other", bracket_02=BRACKET, wide=wider, block=LEG, bracket=BRACKET)
    found = similar_object(right, first_case(BRACKET), [other], np.random.default_rng(0))
    assert found.facts["object"] == SIMILAR
    sampled = torch.from_numpy(wider.sample(4000, np.random.default_rng(1))[0])
    torch.testing.assert_close(ratios(found.points), ratios(sampled), rtol=0, atol=0.02)
    assert float(found.case.obj.signed_distance(found.points.float()).abs().max()) < 1e-3 * float(found.points.std())
