"""Two candidates at one place: what tells them apart, and for which of them what was seen speaks."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch

from regnf_core import library
from regnf_core.document import ABSENT, SHOWN, UNKNOWN, Difference
from regnf_core.fields.observation import Observation, ObservedField, SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3
from regnf_core.library import LibraryObject, model_object, search_library
from regnf_core.options import RegistrationOptions
from regnf_core.robust.problem import make_problem
from regnf_core.robust.scene import view_scene
from regnf_core.robust.verdict.comparison import Placed, compare, decides_for_other
from regnf_core.schema.description import FREE, SURFACE, UNSEEN
from tests.core.analytic import AnalyticField, boxes

OPTIONS = RegistrationOptions().robust
BODY = ([-0.4, -0.3, -0.3], [0.4, 0.3, 0.1])
BLOCK = ([-0.3, -0.2, 0.05], [-0.05, 0.2, 0.35])
PLAIN, WITH_BLOCK = boxes([BODY]), boxes([BODY, BLOCK])
BOX = OrientedBox(torch.zeros(3).double(), torch.tensor([0.9, 0.7, 0.8]).double(), torch.eye(3).double())
HERE = Sim3.identity()


def placed(scene: SdfField, obj: AnalyticField, box: OrientedBox = BOX, T: Sim3 = HERE) -> Placed:
    problem = make_problem(view_scene(scene, box, OPTIONS), model_object(obj, OPTIONS), scene, obj, OPTIONS)
    return Placed(problem, problem.in_working_frames(T), torch.zeros(1).double())


@pytest.mark.parametrize("there", [PLAIN, WITH_BLOCK])
def test_a_block_more_or_less_is_told_by_its_surface(there: AnalyticField) -> None:
    right, wrong = (placed(there, obj) for obj in ((PLAIN, WITH_BLOCK) if there is PLAIN else (WITH_BLOCK, PLAIN)))
    found = compare(right, wrong).difference
    assert found.distinguishable
    assert 0.02 < found.seen <= found.differs < 0.3
    assert found.favor > 0.8
    assert not decides_for_other(found)
    other_way = compare(wrong, right).difference
    assert (other_way.differs, other_way.seen, other_way.favor) == pytest.approx(
        (found.differs, found.seen, -found.favor)
    )
    assert decides_for_other(other_way)


def test_the_deciding_surface_is_told_where_it_stands_and_whose_it_is() -> None:
    """Of a field far from the origin and twice as large: the block alone is another's, and free space in the scene."""
    grown = OrientedBox(torch.tensor([5.0, 0.0, 0.0]).double(), 2.0 * BOX.size, torch.eye(3).double())
    T = Sim3(torch.tensor(0.5).double(), torch.eye(3).double(), torch.tensor([-2.5, 0.0, 0.0]).double())
    bounds = [[3.0, -2.0, -2.0], [7.0, 2.0, 2.0]]
    scene = AnalyticField(lambda points: 2.0 * PLAIN.formula(T.apply(points.double()).float()), bounds)
    plain, block = (placed(scene, obj, grown, T) for obj in (PLAIN, WITH_BLOCK))
    found = compare(plain, block).surface
    low, high = (T.inverse().apply(torch.tensor([corner]).double()) for corner in BLOCK)
    assert len(found.states) == len(found.of_other) == len(found.samples) > 40
    assert ((found.samples.points > low - 0.05) & (found.samples.points < high + 0.05)).all()
    assert (found.states[found.of_other] == ABSENT).all()
    assert (found.states[~found.of_other] == SHOWN).all()
    assert (~found.of_other).any(), "beneath the block"
    assert found.of_other.sum() > 40
    other_way = compare(block, plain).surface
    assert other_way.of_other.sum() == (~found.of_other).sum()


def test_the_same_object_differs_nowhere() -> None:
    found = compare(placed(PLAIN, PLAIN), placed(PLAIN, PLAIN)).difference
    assert (found.differs, found.seen, found.favor, found.distinguishable) == (0.0, 0.0, 0.0, False)


def test_what_nobody_saw_tells_nothing() -> None:
    """Where the block would stand, neither free space nor the top of the body was observed."""
    low, voxel = torch.full((3,), -1.0).double(), 0.02
    axis = -1.0 + (torch.arange(100) + 0.5) * voxel
    centers = torch.cartesian_prod(axis, axis, axis)
    value = PLAIN.signed_distance(centers)
    states = torch.where(value.abs() < voxel, SURFACE, torch.where(value > 0, FREE, UNSEEN))
    states[boxes([BLOCK]).signed_distance(centers) < 4.0 * voxel] = UNSEEN
    scene = ObservedField(PLAIN, Observation(states.to(torch.uint8).view(100, 100, 100), low, voxel))
    found = compare(placed(scene, PLAIN), placed(scene, WITH_BLOCK))
    assert found.difference.differs > 0.02
    assert not found.difference.distinguishable
    assert (found.surface.states == UNKNOWN).double().mean() > 0.8


@pytest.mark.parametrize("there", ["plain", "with block"])
def test_a_search_puts_the_one_first_that_its_difference_speaks_for(there: str) -> None:
    low_block = ([-0.3, -0.15, 0.05], [-0.1, 0.15, 0.2])  # of a higher one, the other is not refined
    shapes = {"plain": PLAIN, "with block": boxes([BODY, low_block])}
    objects = [LibraryObject(name, lambda field=field: field, model_object(field)) for name, field in shapes.items()]
    found = search_library(shapes[there], BOX, objects, clouds=False)
    assert found.ranking[0].name == there
    assert found.ranking[0].difference is None
    second = found.ranking[1].difference
    assert second is not None
    assert second.favor > 0.0
    assert found.result.deciding is not None
    assert len(found.result.deciding.states) > 0


@pytest.mark.parametrize(("first_rejected", "second_rejected", "first"), [(0, 0, 2), (0, 1, 1), (1, 1, 2), (1, 0, 2)])
def test_a_rejected_candidate_never_comes_before_an_accepted_one(
    monkeypatch: pytest.MonkeyPatch, first_rejected: int, second_rejected: int, first: int
) -> None:
    """All that was seen of the difference speaks for the second."""
    apart = SimpleNamespace(difference=Difference(0.1, 0.05, -1.0, True))
    monkeypatch.setattr(library, "compare", lambda one, other: apart)
    refined: list[Any] = [
        (SimpleNamespace(rank=(bool(rejected), 0.0), placed=lambda problem: None), number, None, 0)
        for number, rejected in ((1, first_rejected), (2, second_rejected))
    ]
    assert library._decided(refined) == [apart]
    assert refined[0][1] == first
