"""The errors against a truth, on cases small enough to work out by hand."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from regnf_core.errors import InvalidInputError
from regnf_core.geometry.metrics import (
    ContinuousSymmetry,
    Symmetries,
    add_s,
    diameter,
    errors_against_truth,
    mssd,
    paper_errors,
    rotation_error,
)
from regnf_core.geometry.sim3 import Sim3

SQUARE = torch.tensor([[1.0, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]], dtype=torch.float64)


def turn_z(angle: float, scale: float = 1.0, translation: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Sim3:
    return Sim3.from_quaternion(scale, [0.0, 0.0, math.sin(angle / 2), math.cos(angle / 2)], translation)


HALF_TURN = Symmetries(discrete=[turn_z(math.pi)])
ROUND = Symmetries(continuous=[ContinuousSymmetry((0.0, 0.0, 2.0))])


def test_the_papers_three_by_hand() -> None:
    truth = turn_z(0.1, 1.25, (0.0, 0.0, 0.0))
    estimate = turn_z(0.4, 1.20, (0.3, 0.0, 0.4))
    found = paper_errors(estimate, truth)
    assert found["translation_rmse"] == pytest.approx(math.sqrt(0.25 / 3))
    assert found["euler_rmse_rad"] == pytest.approx(0.3 / math.sqrt(3))
    assert found["scale_error"] == pytest.approx(0.05)
    wrapped = paper_errors(turn_z(math.pi - 0.1), turn_z(-math.pi + 0.1))  # at a full turn
    assert wrapped["euler_rmse_rad"] == pytest.approx(0.2 / math.sqrt(3))


def test_rotation_error_is_the_angle_between() -> None:
    quarter_about_x = Sim3.from_quaternion(2.0, [math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)], [1.0, 2.0, 3.0])
    assert rotation_error(quarter_about_x, Sim3.identity()) == pytest.approx(math.pi / 2)
    assert rotation_error(turn_z(3.0), turn_z(-3.0)) == pytest.approx(2 * math.pi - 6.0)


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


def test_mssd_is_in_object_units_whatever_the_scale() -> None:
    # In the scene the object is ten times smaller; a shift of 0.1 scene units is 1 object unit.
    truth = turn_z(0.0, 10.0)
    estimate = truth @ Sim3.from_translation(torch.tensor([0.1, 0.0, 0.0], dtype=torch.float64))
    assert mssd(estimate, truth, SQUARE) == pytest.approx(1.0)


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


def test_add_s_forgives_what_mssd_does_not() -> None:
    assert add_s(turn_z(math.pi), Sim3.identity(), SQUARE) == pytest.approx(0.0, abs=1e-12)
    lifted = Sim3.from_translation(torch.tensor([0.0, 0.0, 0.5], dtype=torch.float64))
    assert add_s(lifted, Sim3.identity(), SQUARE) == pytest.approx(0.5)


def test_all_errors_vanish_for_the_truth_and_have_the_promised_names() -> None:
    T = turn_z(0.3, 1.25, (0.1, 0.2, 0.3))
    errors = errors_against_truth(T, T, SQUARE)
    assert {"rotation_error_rad", "center_error_share", "scale_error_share", "mssd_share"} <= set(errors)
    assert all(value == pytest.approx(0.0, abs=1e-7) for value in errors.values())


def test_shares_are_of_the_diameter() -> None:
    shifted = Sim3.from_translation(torch.tensor([0.1, 0.0, 0.0], dtype=torch.float64))
    errors = errors_against_truth(shifted, Sim3.identity(), SQUARE)
    assert errors["center_error_share"] == pytest.approx(0.1 / math.sqrt(8))
    assert errors["mssd_share"] == pytest.approx(0.1 / math.sqrt(8))


@pytest.mark.parametrize("far", [0.0, 7.0, 60.0, 1000.0])
def test_no_error_depends_on_where_the_scenes_origin_is(far: float) -> None:
    """A pose that is off by a little, told by a scene whose origin lies elsewhere. The paper's translation error is
    the counter-example."""
    truth, step = turn_z(0.3, 1.25, (0.1, 0.2, 0.3)), torch.tensor([0.01, 0.0, 0.02, 0.01, 0.0, 0.0, 0.003]).double()
    estimate = truth.perturb(step)
    move = Sim3.from_translation(torch.tensor([0.6, -0.64, 0.48], dtype=torch.float64) * far)
    here, there = (
        errors_against_truth(estimate, truth, SQUARE),
        errors_against_truth(estimate @ move, truth @ move, SQUARE),
    )
    assert there == pytest.approx(here, rel=1e-6, abs=1e-7)
    assert (paper_errors(estimate @ move, truth @ move)["translation_rmse"] > 0.06) == (far > 1.0)


def test_the_centers_error_is_in_scene_units_and_over_the_symmetries() -> None:
    truth = turn_z(0.0, 2.0, (0.4, 0.0, 0.0))
    center = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)  # not on the axis
    turned = turn_z(math.pi) @ truth
    assert errors_against_truth(turned, truth, SQUARE, HALF_TURN, center)["center_error"] == pytest.approx(
        0.0, abs=1e-9
    )
    assert errors_against_truth(turned, truth, SQUARE, None, center)["center_error"] == pytest.approx(2.0 / 2.0)


@pytest.mark.parametrize(
    ("points", "expected"),
    [
        (SQUARE, math.sqrt(8)),  # flat: no hull in space
        (torch.cat([SQUARE, SQUARE + torch.tensor([0.0, 0.0, 1.0])]), 3.0),
        (torch.zeros(1, 3), 0.0),
        (torch.tensor([[0.0, 0, 0], [1, 0, 0], [4, 0, 0]]), 4.0),
    ],
)
def test_diameter(points: Tensor, expected: float) -> None:
    assert diameter(points) == pytest.approx(expected)


def test_symmetries_in_bops_words() -> None:
    matrix = turn_z(math.pi).matrix().reshape(-1).tolist()
    found = Symmetries.from_dict({"symmetries_discrete": [matrix], "symmetries_continuous": [{"axis": [0, 1, 0]}]})
    assert found.transforms(steps=4).scale.shape == (8,)
    for broken in (
        {"symmetries_discrete": [[1, 2, 3]]},
        {"symmetries_continuous": [{"offset": [0, 0, 0]}]},
        {"symmetries_continuous": [{"axis": [1, 2]}]},
    ):
        with pytest.raises(InvalidInputError) as caught:
            Symmetries.from_dict(broken)
        assert caught.value.reason == "INVALID_SYMMETRY"
    with pytest.raises(InvalidInputError):
        Symmetries(continuous=[ContinuousSymmetry((0, 0, 0))]).transforms()
