"""Questions about a box: wrong objects differ as they are said to, wrong boxes hold nothing of the right one."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from benchmarks.random_worlds.mesh import Mesh, block, together
from benchmarks.random_worlds.models import Model
from benchmarks.robust.cases import Case
from benchmarks.symmetric_errors import Symmetries
from benchmarks.worlds.cases import WorldCase
from benchmarks.worlds.making import WORLD
from benchmarks.worlds.questions import Kind, Question, ask
from regnf_core import OrientedBox, Sim3
from regnf_core.fields.mesh import MeshField
from regnf_core.fields.observation import Observation
from regnf_core.library import model_object
from regnf_core.options import RobustOptions
from regnf_core.robust.problem import make_problem
from regnf_core.robust.scene import view_scene
from regnf_core.schema.description import FREE, UNSEEN

T_OBJECT_MODEL = np.diag([2.0, 2.0, 2.0, 1.0])
SEAT, CUSHION = block([0.0, 0.0, 0.2], [0.5, 0.5, 0.4]), block([0.0, 0.0, 0.55], [0.3, 0.2, 0.2])
CHAIR = together(SEAT, CUSHION)
SIZE = 2.0 * float(np.linalg.norm([0.5, 0.5, 0.65]))


def observation(state: int) -> Observation:
    return Observation(torch.full((10, 10, 10), state, dtype=torch.uint8), torch.full((3,), -5.0).double(), 1.0)


def case_of(mesh: Mesh, name: str, T_object_model: NDArray[np.float64], number: int = 0, at: float = 0.0) -> WorldCase:
    """The scene's frame is the object's; the box and its object stand at x = ``at``."""
    field = MeshField(mesh.vertices, mesh.faces).transformed(T_object_model)
    center = torch.tensor([at, 0.0, 0.65]).double()
    box = OrientedBox(center, torch.tensor([1.1, 1.1, 1.4]).double(), torch.eye(3).double())
    truth = Sim3.from_translation(torch.tensor([-at, 0.0, 0.0]).double())
    case = Case(f"a {name}", field, field, box, truth)
    points = Sim3.from_matrix(T_object_model.tolist()).apply(torch.from_numpy(Model(name, mesh).surface))
    return WorldCase(case, {"case": number, "object": name}, points, Symmetries(), observation(FREE))


def world(folder: Path, **objects: Mesh) -> Path:
    """A folder with these objects, by name."""
    folder.mkdir(exist_ok=True)
    for number, mesh in enumerate(objects.values()):
        np.savez(folder / f"object-{number}.npz", vertices=mesh.vertices, faces=mesh.faces)
    cases = [{"name": name, "T_object_model": T_OBJECT_MODEL.tolist()} for name in objects]
    (folder / WORLD).write_text(json.dumps({"cases": cases, "things": list(objects)}))
    return folder


def asked(folder: Path, kind: Kind, **others: Any) -> Question:
    home = world(folder / f"world-{others.pop('seed', 0)}", chair=CHAIR, lamp=SEAT)
    cases = [case_of(CHAIR, "chair", T_OBJECT_MODEL), case_of(SEAT, "lamp", T_OBJECT_MODEL, 1, at=3.0)]
    found = ask(kind, home, cases, 0, others.get("homes", []))
    assert found is not None
    return found


def differing(question: Question) -> torch.Tensor:
    """(N, 3) points about both objects where one is matter and the other is not."""
    axis = torch.linspace(-2.013, 1.987, 41)  # no point lies on a face
    points = torch.cartesian_prod(axis, axis, axis)
    inside = [case.case.obj.signed_distance(points) < 0.0 for case in (question.known, question.asked)]
    return points[inside[0] != inside[1]]


@pytest.mark.parametrize("seed", [0, 3])
@pytest.mark.parametrize("kind", ["part less", "part more"])
def test_a_part_is_missing_or_a_block_is_added(tmp_path: Path, kind: Kind, seed: int) -> None:
    question = asked(tmp_path, kind, seed=seed)
    where = differing(question)
    assert len(where) > 0
    assert float((where.amax(0) - where.amin(0)).max()) < 0.45 * SIZE
    assert float(question.asked.case.obj.signed_distance(question.asked.points.float()).abs().max()) < 1e-3


def extent(one: WorldCase) -> torch.Tensor:
    return one.points.amax(0) - one.points.amin(0)


def test_longer_objects_are_longer_along_one_axis_by_3_to_10_percent(tmp_path: Path) -> None:
    question = asked(tmp_path, "longer")
    ratio = (extent(question.asked) / extent(question.known)).sort().values
    torch.testing.assert_close(ratio[:2], torch.ones(2).double(), rtol=0, atol=0.01)
    assert 1.02 <= float(ratio[2]) <= 1.11


def test_boxes_of_wrong_places_hold_nothing_of_the_object(tmp_path: Path) -> None:
    for kind in ("neighbor", "empty"):
        question = asked(tmp_path, kind)
        box, truth = question.asked.case.detection, question.known.case.truth
        assert truth is not None
        assert float(box.contains(truth.inverse().apply(question.known.points)).double().mean()) <= 0.1
        assert question.asked.case.obj is question.known.case.obj
    beside = asked(tmp_path, "half beside").asked.case.detection
    assert 0.3 * 1.1 <= float((beside.center - torch.tensor([0.0, 0.0, 0.65])).norm()) <= 0.5 * 1.4


def test_an_object_that_stands_there_twice_has_no_wrong_place(tmp_path: Path) -> None:
    home = world(tmp_path / "w", chair=CHAIR, lamp=SEAT)
    told = json.loads((home / WORLD).read_text())
    (home / WORLD).write_text(json.dumps({**told, "things": ["chair", "chair", "lamp"]}))
    cases = [case_of(CHAIR, "chair", T_OBJECT_MODEL), case_of(SEAT, "lamp", T_OBJECT_MODEL, 1, at=3.0)]
    assert ask("neighbor", home, cases, 0, []) is None


def problem_of(question: Question) -> Any:
    case, options = question.asked.case, RobustOptions()
    return make_problem(
        view_scene(case.scene, case.detection, options),
        model_object(case.obj, RobustOptions()),
        case.scene,
        case.obj,
        options,
    )


def test_errors_of_wrong_objects_are_distances_of_surfaces(tmp_path: Path) -> None:
    """At the true pose, a missing cushion leaves a part of the true surface far off; the right object's none."""
    right, less = asked(tmp_path, "right"), asked(tmp_path, "part less")
    for question, low, high in ((right, 0.0, 1e-6), (less, 0.05, 0.4)):
        problem = problem_of(question)
        T = problem.in_working_frames(Sim3.identity())
        assert low <= question.errors(problem, T[None])[0] <= high
    problem = problem_of(less)
    differs, seen = less.seen_difference(problem, problem.in_working_frames(Sim3.identity()))
    assert 0.02 < differs == seen < 0.4
    hidden = replace(less, known=replace(less.known, seen=observation(UNSEEN)))
    assert hidden.seen_difference(problem, problem.in_working_frames(Sim3.identity())) == (differs, 0.0)


# Similar objects have the right object's shape, nearly, and are no copy of it.

LEG, BRANCH = block([0.0, 0.0, 0.5], [0.1, 0.1, 1.0]), block([0.3, 0.0, 0.9], [0.5, 0.1, 0.1])
BRACKET = together(LEG, BRANCH)


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
    found = ask("similar", right, [case_of(BRACKET, "bracket", np.eye(4))], 0, [other])
    assert found is not None
    sampled = torch.from_numpy(Model("", wider).surface)
    torch.testing.assert_close(ratios(found.asked.points), ratios(sampled), rtol=0, atol=0.02)
    deviation = found.asked.case.obj.signed_distance(found.asked.points.float()).abs().max()
    assert float(deviation) < 1e-3 * float(found.asked.points.std())
