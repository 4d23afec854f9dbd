"""Color in any frame and unit: the same place seen along the same line has the same color."""

from __future__ import annotations

import pickle

import pytest
import torch
from torch import Tensor

from benchmarks.solids import BoxField, UnionField
from regnf_core.fields.build import ScaledField
from regnf_core.fields.composite import TransformedField
from regnf_core.fields.observation import (
    ColoredField,
    Observation,
    ObservedField,
    SdfField,
    has_color,
    inverse_deviation_of,
)
from regnf_core.geometry.sim3 import Sim3
from tests.core.analytic import sphere


class PaintedBox(BoxField):
    """A box whose color tells the place and the direction that were asked for."""

    inverse_deviation = 40.0

    def color(self, points: Tensor, directions: Tensor) -> Tensor:
        return 0.5 + 0.05 * points + 0.3 * directions


PAINTED = PaintedBox((-1.0, -0.5, -0.25), (1.0, 0.5, 0.25))
PLAIN = BoxField((-1.0, -0.5, -0.25), (1.0, 0.5, 0.25))
T_BOX_FRAME = Sim3.exp(torch.tensor([0.4, -0.8, 2.1, 0.3, -0.2, 0.1, 0.9], dtype=torch.float64))


def unseen() -> Observation:
    return Observation(torch.zeros(2, 2, 2, dtype=torch.uint8), torch.zeros(3, dtype=torch.float64), 1.0)


def questions(count: int = 50) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    points, directions = torch.randn(2, count, 3, generator=generator)
    return points, torch.nn.functional.normalize(directions, dim=-1)


def test_a_field_without_color_has_none() -> None:
    views: list[SdfField] = [PLAIN, TransformedField(PLAIN, T_BOX_FRAME), ScaledField(PLAIN, 2.0)]
    views += [ObservedField(PLAIN, unseen()), UnionField([PLAIN, PAINTED]), sphere(0.5)]
    for view in views:
        assert not has_color(view)
        assert not isinstance(view, ColoredField)
        assert inverse_deviation_of(view) is None


VIEWS = {
    "frame": (TransformedField(PAINTED, T_BOX_FRAME), T_BOX_FRAME, 1.0),
    "unit": (ScaledField(PAINTED, 4.0, -1), Sim3.identity(), 4.0),
    "both": (TransformedField(ScaledField(ObservedField(PAINTED, unseen()), 3.0), T_BOX_FRAME), T_BOX_FRAME, 3.0),
}
"""Each with the transform from its frame, and the unit of what that leads to."""


@pytest.mark.parametrize("name", VIEWS)
def test_color_and_opacity_are_those_of_the_same_place_in_every_frame_and_unit(name: str) -> None:
    """NeuS's opacity depends on s S(x) alone, so that s must change with the unit of S."""
    points, directions = questions()
    view, T, unit = VIEWS[name]
    assert has_color(view)
    moved, turned = T.apply(points.double()).float() / unit, directions @ T.rotation.float().T
    torch.testing.assert_close(view.color(points, directions), 0.5 + 0.05 * moved + 0.3 * turned)
    assert view.inverse_deviation == pytest.approx(40.0 * float(T.scale) / unit)
    distance = view.signed_distance(points) * (-1 if name == "unit" else 1)
    torch.testing.assert_close(distance * view.inverse_deviation, PAINTED.signed_distance(moved) * 40.0)
    again = pickle.loads(pickle.dumps(view.to("cpu")))  # as it is sent to another process
    torch.testing.assert_close(again.color(points, directions), view.color(points, directions))


def test_a_union_has_the_color_of_the_nearest_part() -> None:
    moved = TransformedField(PAINTED, Sim3.from_translation(torch.tensor([-5.0, 0.0, 0.0], dtype=torch.float64)))
    union = UnionField([PAINTED, moved])
    assert has_color(union)
    points = torch.tensor([[0.9, 0.0, 0.0], [4.1, 0.0, 0.0]])
    directions = torch.tensor([[0.0, 0.0, 1.0]]).expand(2, 3)
    expected = PAINTED.color(torch.tensor([[0.9, 0.0, 0.0], [-0.9, 0.0, 0.0]]), directions)
    torch.testing.assert_close(union.color(points, directions), expected)
    assert union.inverse_deviation == 40.0
