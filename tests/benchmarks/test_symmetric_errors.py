"""Errors over an object's declared symmetries, on cases small enough to work out by hand."""

from __future__ import annotations

import math

import pytest
import torch

from benchmarks.symmetric_errors import ContinuousSymmetry, Symmetries, errors_against_truth, mssd, rotation_error
from regnf_core.geometry.sim3 import Sim3
from tests.core.geometry.test_metrics import SQUARE, turn_z

HALF_TURN = Symmetries(discrete=[turn_z(math.pi)])
ROUND = Symmetries(continuous=[ContinuousSymmetry((0.0, 0.0, 2.0))])


@pytest.mark.parametrize(
    ("angle", "symmetries", "expected"),
    [
        (math.pi, None, math.pi),
        (math.pi, HALF_TURN, 0.0),
        (math.pi - 0.1, HALF_TURN, 0.1),
        (math.pi / 2, HALF_TURN, math.pi / 2),
        (2 * math.pi * 100 / 315, ROUND, 0.0),
    ],
)
def test_rotation_error_modulo_symmetry(angle: float, symmetries: Symmetries | None, expected: float) -> None:
    assert rotation_error(turn_z(angle), Sim3.identity(), symmetries) == pytest.approx(expected, abs=1e-9)


def test_mssd_by_hand() -> None:
    # Half a turn carries each corner of the square to the opposite one, a diagonal (2 sqrt 2) away.
    assert mssd(turn_z(math.pi), Sim3.identity(), SQUARE) == pytest.approx(2 * math.sqrt(2))
    assert mssd(turn_z(math.pi), Sim3.identity(), SQUARE, HALF_TURN) == pytest.approx(0.0, abs=1e-12)
    # A scale too large by a quarter puts the corners, sqrt 2 from the center, at 1 / 1.25 of that.
    assert mssd(turn_z(0, 1.25), Sim3.identity(), SQUARE) == pytest.approx(0.2 * math.sqrt(2))


def test_mssd_forgives_any_turn_of_a_round_thing_but_no_tilt() -> None:
    step = 2 * math.pi / 315
    assert mssd(turn_z(17 * step), Sim3.identity(), SQUARE, ROUND) == pytest.approx(0.0, abs=1e-9)
    between = mssd(turn_z(17.5 * step), Sim3.identity(), SQUARE, ROUND)
    assert between == pytest.approx(2 * math.sqrt(2) * math.sin(step / 4), rel=1e-6)
    tilt = Sim3.from_quaternion(1.0, [math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)], [0.0, 0.0, 0.0])
    assert mssd(tilt, Sim3.identity(), SQUARE, ROUND) > 0.5


def test_symmetry_about_an_axis_off_the_origin() -> None:
    axis = Symmetries(continuous=[ContinuousSymmetry((0, 0, 1), (1.0, 0.0, 0.0))])
    turned = axis.transforms(steps=4)  # identity, then quarter turns about x = 1
    moved = turned.apply(torch.zeros(1, 3, dtype=torch.float64))[:, 0]
    expected = torch.tensor([[0, 0, 0], [1, -1, 0], [2, 0, 0], [1, 1, 0]], dtype=torch.float64)
    torch.testing.assert_close(moved, expected, rtol=0, atol=1e-12)


def test_the_centers_error_is_over_the_symmetries() -> None:
    truth = turn_z(0.0, 2.0, (0.4, 0.0, 0.0))
    center = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)  # not on the axis
    turned = turn_z(math.pi) @ truth
    assert errors_against_truth(turned, truth, SQUARE, HALF_TURN, center)["center_error"] == pytest.approx(
        0.0, abs=1e-9
    )
    assert errors_against_truth(turned, truth, SQUARE, None, center)["center_error"] == pytest.approx(2.0 / 2.0)


def test_symmetries_in_bops_words() -> None:
    matrix = turn_z(math.pi).matrix().reshape(-1).tolist()
    found = Symmetries.from_dict({"symmetries_discrete": [matrix], "symmetries_continuous": [{"axis": [0, 1, 0]}]})
    assert found.transforms(steps=4).scale.shape == (8,)
    for broken in (
        {"symmetries_discrete": [[1, 2, 3]]},
        {"symmetries_continuous": [{"offset": [0, 0, 0]}]},
        {"symmetries_continuous": [{"axis": [1, 2]}]},
    ):
        with pytest.raises(ValueError, match="symmetr"):
            Symmetries.from_dict(broken)
    with pytest.raises(ValueError, match="symmetr"):
        Symmetries(continuous=[ContinuousSymmetry((0, 0, 0))]).transforms()
