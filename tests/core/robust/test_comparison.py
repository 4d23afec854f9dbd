"""Two candidates at one place: what tells them apart, and for which of them what was seen speaks."""

from __future__ import annotations

import pytest
import torch

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


def placed(scene: SdfField, obj: AnalyticField) -> Placed:
    problem = make_problem(view_scene(scene, BOX, OPTIONS), model_object(obj, OPTIONS), scene, obj, OPTIONS)
    return Placed(problem, problem.in_working_frames(Sim3.identity()), torch.zeros(1).double())


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
    found = compare(placed(scene, PLAIN), placed(scene, WITH_BLOCK)).difference
    assert found.differs > 0.02
    assert not found.distinguishable


@pytest.mark.parametrize("there", ["plain", "with block"])
def test_a_search_puts_the_one_first_that_its_difference_speaks_for(there: str) -> None:
    shapes = {"plain": PLAIN, "with block": WITH_BLOCK}
    library = [LibraryObject(name, lambda field=field: field, model_object(field)) for name, field in shapes.items()]
    found = search_library(shapes[there], BOX, library, clouds=False)
    assert found.ranking[0].name == there
    assert found.ranking[0].difference is None
    second = found.ranking[1].difference
    assert second is not None
    assert second.favor > 0.0
