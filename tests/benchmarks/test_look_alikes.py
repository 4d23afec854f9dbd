"""Look-alikes differ from the right object by a part, and by nothing else."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from benchmarks.random_worlds.mesh import Mesh, block, together
from benchmarks.robust.cases import Case
from benchmarks.symmetric_errors import Symmetries
from benchmarks.worlds.cases import WorldCase
from benchmarks.worlds.look_alikes import LOOK_ALIKE, look_alike
from benchmarks.worlds.making import WORLD
from benchmarks.worlds.similar_objects import SIMILAR, similar_object
from regnf_core import OrientedBox, Sim3
from regnf_core.fields.mesh import MeshField

T_OBJECT_MODEL = np.diag([2.0, 2.0, 2.0, 1.0])
SEAT, CUSHION = block([0.0, 0.0, 0.2], [0.5, 0.5, 0.4]), block([0.0, 0.0, 0.55], [0.3, 0.2, 0.2])


def known(folder: Path, mesh: Mesh) -> WorldCase:
    np.savez(folder / "object-0.npz", vertices=mesh.vertices, faces=mesh.faces)
    (folder / WORLD).write_text(json.dumps({"cases": [{"T_object_model": T_OBJECT_MODEL.tolist()}]}))
    return first_case(mesh, "seat", T_OBJECT_MODEL)


def first_case(mesh: Mesh, name: str, T_object_model: NDArray[np.float64]) -> WorldCase:
    field = MeshField(mesh.vertices, mesh.faces).transformed(T_object_model)
    box = OrientedBox(torch.zeros(3).double(), torch.ones(3).double(), torch.eye(3).double())
    case = Case(f"a {name}", field, field, box, Sim3.identity())
    return WorldCase(case, {"case": 0, "object": name}, torch.zeros(0, 3), Symmetries())


def differing(one: WorldCase, other: WorldCase) -> torch.Tensor:
    """(N, 3) points about both, object frame, where one is matter and the other is not."""
    axis = torch.linspace(-2.013, 1.987, 41)  # no point lies on a face
    points = torch.cartesian_prod(axis, axis, axis)
    inside = [case.case.obj.signed_distance(points) < 0.0 for case in (one, other)]
    return points[inside[0] != inside[1]]


@pytest.mark.parametrize("seed", [0, 3])
def test_a_part_is_missing_or_a_block_is_added(tmp_path: Path, seed: int) -> None:
    right = known(tmp_path, together(SEAT, CUSHION))
    other = look_alike(tmp_path, right, np.random.default_rng(seed))
    assert other.facts["object"] == LOOK_ALIKE
    assert right.facts["object"] == "seat"
    where = differing(right, other)
    assert len(where) > 0
    extent = where.amax(0) - where.amin(0)
    assert float(extent.max()) < 0.45 * 2.0 * float(np.linalg.norm([0.5, 0.5, 0.65]))
    assert float(other.case.obj.signed_distance(other.points.float()).abs().max()) < 1e-3


# Similar objects have the right object's shape, nearly, and are no copy of it.

LEG, BRANCH = block([0.0, 0.0, 0.5], [0.1, 0.1, 1.0]), block([0.3, 0.0, 0.9], [0.5, 0.1, 0.1])
BRACKET = together(LEG, BRANCH)


def world(folder: Path, **objects: Mesh) -> Path:
    """A folder with these objects, by name."""
    folder.mkdir()
    for number, mesh in enumerate(objects.values()):
        np.savez(folder / f"object-{number}.npz", vertices=mesh.vertices, faces=mesh.faces)
    (folder / WORLD).write_text(json.dumps({"cases": [{"name": name} for name in objects]}))
    return folder


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
    found = similar_object(right, first_case(BRACKET, "bracket", np.eye(4)), [other], np.random.default_rng(0))
    assert found.facts["object"] == SIMILAR
    sampled = torch.from_numpy(wider.sample(4000, np.random.default_rng(1))[0])
    torch.testing.assert_close(ratios(found.points), ratios(sampled), rtol=0, atol=0.02)
    assert float(found.case.obj.signed_distance(found.points.float()).abs().max()) < 1e-3 * float(found.points.std())
