"""What is asked of a detection box: the right object, and wrong ones as they come; and how right an answer is.

Wrong are objects that differ from the right one (by a part, by a length, as its mirror image, as a package of another
size, as another model of its kind) and boxes without it: an empty place, a neighbor's box. A box may also be half
beside the object; its pose is right then all the same.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from benchmarks.random_worlds.mesh import Array, Mesh, block, together
from benchmarks.random_worlds.models import BIG_M, Catalog, Model
from benchmarks.symmetric_errors import Symmetries
from benchmarks.worlds.cases import WorldCase, cases_of
from benchmarks.worlds.making import WORLD, read_object_mesh, similarity
from benchmarks.worlds.stages import NearestTruth
from regnf_core import OrientedBox, Sim3
from regnf_core.fields.mesh import MeshField
from regnf_core.robust.problem import RegistrationProblem
from regnf_core.schema.description import UNSEEN

Kind = Literal[
    "right", "half beside", "part less", "part more", "longer", "mirrored", "resized", "similar", "other", "neighbor",
    "empty",
]  # fmt: skip
KINDS: tuple[Kind, ...] = get_args(Kind)
ALTERED: tuple[Kind, ...] = ("part less", "part more", "longer", "mirrored", "resized")
"""The right object, changed: where it would stand is known."""
_PART = (0.03, 0.4)
"""Shares of the surface that a missing part may have."""
_BLOCK = (0.12, 0.3)
"""Edges of an additional block, diameters."""
_REACH = 0.05
"""Diameters that a part reaches beyond the rest, at least."""
_LONGER = (0.03, 0.1)
_RESIZED = (0.7, 1.4)
"""Factors along each axis of a package."""
DIFFERS = 0.03
"""Diameters: surface farther from the other surface differs."""
_DRAWN = 24
"""Parametric things among which the most similar one is looked for; as many more are objects of other worlds."""
_POINTS, _SHAPE, _TURNS = 800, 400, 8
_SCALES = (0.05, 20.0)
_TRIES = 40
_MOST_COVERED = 0.1
"""Of the object's surface, in a box that counts as empty of it."""


@dataclass(frozen=True, eq=False)
class Question:
    """known: the case that the box is of · asked: the same with the object and the box that are asked with."""

    kind: Kind
    known: WorldCase
    asked: WorldCase

    def errors(self, problem: RegistrationProblem, T: Sim3) -> list[float]:
        """Of poses (H,) between the working frames, diameters of the object: MSSD of the right object; of others, how
        far half a percent of both surfaces, its own as it is placed and the true one, are off the other at least."""
        truth = self.known.case.truth
        assert truth is not None
        if self.asked.case.obj is self.known.case.obj:
            symmetries = _equals(self.known.case.symmetries, self.known.near)
            found: list[float] = NearestTruth(problem, truth, self.known.points, symmetries).errors(T).tolist()
            return found
        return [float(np.quantile(far, 0.995)) for far in self._differences(problem, T)]

    def seen_difference(self, problem: RegistrationProblem, T: Sim3) -> tuple[float, float]:
        """Of one pose: the share of both surfaces that differs, and the share that differs and was seen."""
        far = self._differences(problem, T[None])[0]
        places = torch.from_numpy(np.concatenate(self._surfaces(problem, T)))
        differs, seen = far > DIFFERS, (self.known.seen.at(places) != UNSEEN).numpy()
        return float(differs.mean()), float((differs & seen).mean())

    def _surfaces(self, problem: RegistrationProblem, T: Sim3) -> tuple[Array, Array]:
        """The true surface and the object's as a pose places it, scene frame."""
        truth = self.known.case.truth
        assert truth is not None
        found = problem.in_field_frames(T)
        true, mine = _few(self.known.points), _few(self.asked.points)
        return truth.inverse().apply(true).numpy(), found.inverse().apply(mine).numpy()

    def _differences(self, problem: RegistrationProblem, T: Sim3) -> list[Array]:
        """For each pose, how far each point of both surfaces is from the other surface, diameters."""
        found = []
        for one in T:
            true, mine = self._surfaces(problem, one)
            size = float(np.linalg.norm(np.ptp(mine, axis=0)))
            far = np.concatenate([KDTree(mine).query(true)[0], KDTree(true).query(mine)[0]])
            found.append(np.maximum(far / size - 0.5 / np.sqrt(_POINTS), 0.0))
        return found


def ask(kind: Kind, home: Path, cases: Sequence[WorldCase], number: int, others: Sequence[Path]) -> Question | None:
    """A question about a case of a world's folder; None where there is no such question.

    cases: all of the world · others: folders of worlds of the same part.
    """
    known = cases[number]
    rng = np.random.default_rng([*home.name.encode(), number, KINDS.index(kind)])
    if kind == "right":
        return Question(kind, known, known)
    if kind == "half beside":
        return Question(kind, known, _with_box(known, _beside(known, rng)))
    if kind in ("neighbor", "empty"):
        alone = json.loads((home / WORLD).read_text())["things"].count(known.facts["object"]) == 1
        found = _elsewhere(kind, cases, number, rng) if alone else None
        return None if found is None else Question(kind, known, _with_box(known, found))
    if kind == "other":
        asked = _another(known, others, rng)
    elif kind == "similar":
        asked = _similar(home, known, others, rng)
    else:
        asked = _altered(kind, home, known, rng)
    return None if asked is None else Question(kind, known, asked)


def _equals(exact: Symmetries, near: Symmetries) -> Symmetries:
    """What places are equal by: turns that hold within 1 % of the diameter, and any turn about an axis where these hold
    within 3 %: of a vase that is nearly round, no list of poses could name them all."""
    return near if near.continuous else exact


def _few(points: Tensor) -> Tensor:
    return points[:: max(1, len(points) // _POINTS)].double()


def _with_box(known: WorldCase, box: OrientedBox) -> WorldCase:
    return replace(known, case=replace(known.case, detection=box))


def _beside(known: WorldCase, rng: np.random.Generator) -> OrientedBox:
    """The box moved by up to half of one of its edges."""
    box = known.case.detection
    axis, share = int(rng.integers(3)), float(rng.uniform(0.3, 0.5) * rng.choice([-1.0, 1.0]))
    return OrientedBox(box.center + share * box.size[axis] * box.rotation[:, axis], box.size, box.rotation)


def _elsewhere(kind: Kind, cases: Sequence[WorldCase], number: int, rng: np.random.Generator) -> OrientedBox | None:
    """A box that holds nearly nothing of the object: another thing's, or its own in another place."""
    known = cases[number]
    truth = known.case.truth
    assert truth is not None
    surface = truth.inverse().apply(_few(known.points))
    elsewhere = [one for one in range(len(cases)) if one != number]
    for _ in range(_TRIES if elsewhere else 0):
        box = cases[int(rng.choice(elsewhere))].case.detection
        if kind == "empty":
            own = known.case.detection
            shift = torch.from_numpy(rng.normal(scale=0.7, size=3)) * box.size
            box = OrientedBox(box.center + box.rotation @ shift, own.size, own.rotation)
        if float(box.contains(surface, 0.2).double().mean()) <= _MOST_COVERED:
            return box
    return None


def _another(known: WorldCase, others: Sequence[Path], rng: np.random.Generator) -> WorldCase | None:
    """With an object of another kind, from one of the other worlds."""
    if not others:
        return None
    kind = known.facts["object"].split("_")[0]
    drawn = others[int(rng.integers(len(others)))]
    found = [one for one in cases_of(drawn) if one.facts["object"].split("_")[0] != kind]
    return _instead(known, found[int(rng.integers(len(found)))]) if found else None


def _instead(known: WorldCase, other: WorldCase) -> WorldCase:
    return replace(known, case=replace(known.case, obj=other.case.obj), facts=other.facts, points=other.points)


def _of_mesh(known: WorldCase, mesh: Mesh, T_object_model: Sim3) -> WorldCase:
    """With a mesh in place of the right object."""
    field = MeshField(mesh.vertices, mesh.faces).transformed(T_object_model.matrix().numpy())
    points = T_object_model.apply(torch.from_numpy(Model("", mesh).surface))
    return replace(known, case=replace(known.case, obj=field), points=points)


def _altered(kind: Kind, home: Path, known: WorldCase, rng: np.random.Generator) -> WorldCase | None:
    number = known.facts["case"]
    mesh = read_object_mesh(home, number)
    altered: Mesh | None
    if kind == "part less":
        altered = _without_a_part(mesh, rng)
    elif kind == "part more":
        altered = _with_a_block(mesh, rng)
    else:
        factors = np.ones(3)
        if kind == "longer":
            factors[int(rng.integers(3))] += rng.uniform(*_LONGER)
        elif kind == "resized":
            factors = np.exp(rng.uniform(*np.log(_RESIZED), 3))
        else:
            factors[int(rng.integers(2))] = -1.0
        altered = mesh.moved(np.diag([*factors, 1.0]))
        if kind == "mirrored":
            altered = Mesh(altered.vertices, altered.faces[:, ::-1].copy())
    if altered is None:
        return None
    T_object_model = Sim3.from_matrix(json.loads((home / WORLD).read_text())["cases"][number]["T_object_model"])
    return _of_mesh(known, altered, T_object_model)


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
        if _PART[0] <= share <= _PART[1] and _reach(mesh, part, rest) >= _REACH:
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
    size = rng.uniform(*_BLOCK, 3) * float(np.linalg.norm(mesh.size))
    center = points[0] + 0.25 * size.min() * normals[0]
    return together(mesh, block(center.tolist(), size.tolist()))


def _similar(home: Path, known: WorldCase, others: Sequence[Path], rng: np.random.Generator) -> WorldCase:
    """With the most similar one of a few dozen things, at any scale: half of them are objects of other worlds, under
    other names; the rest is parametric and drawn anew. Sizes do not count, since a registration looks for the scale."""
    right = read_object_mesh(home, known.facts["case"])
    listed = [*_of_worlds(others, known.facts["object"], rng), *_parametric(right, rng)]
    shape = _shape(right, rng)
    mesh = min(listed, key=lambda one: _difference(shape, _shape(one, rng)))
    return _of_mesh(known, mesh, Sim3.from_matrix(similarity(rng, _SCALES)))


def _of_worlds(homes: Sequence[Path], name: str, rng: np.random.Generator) -> Iterator[Mesh]:
    """Objects of other names, one of each name, as many as are drawn. Names that begin with one another are the same:
    they are an object and its variants."""
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
    points = mesh.sample(_SHAPE, rng)[0]
    low, high = points.min(axis=0), points.max(axis=0)
    return np.asarray((points - (low + high) / 2.0) / np.linalg.norm(high - low))


def _difference(a: Array, b: Array) -> float:
    """Mean distance between two shapes, either way, in the best of a few turns about the up axis."""
    of_a = KDTree(a)
    turns = (Rotation.from_euler("z", 2.0 * np.pi * step / _TURNS).apply(b) for step in range(_TURNS))
    return min(float(of_a.query(turned)[0].mean() + KDTree(turned).query(a)[0].mean()) for turned in turns)
