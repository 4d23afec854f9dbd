"""Leads of poses over other answers, by hand: near poses and symmetric ones are the same answer."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from regnf_core.geometry.sim3 import Sim3
from regnf_core.robust.model import SelfSymmetry
from regnf_core.robust.search.bounds import turns_about
from regnf_core.robust.verdict.answer import apart, apart_from_answer, leads, merits

POINTS = torch.tensor([[0.5, 0.0, 0.0], [-0.5, 0.0, 0.0], [0.0, 0.3, 0.0], [0.0, 0.0, 0.4]])
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def no_symmetry() -> SelfSymmetry:
    return SelfSymmetry(Sim3.identity()[None][:0], None, torch.zeros(0))


def turns(*angles: float) -> Sim3:
    """Turns about the upright axis, as transforms (K,)."""
    rotations = torch.stack([rotation_about_up(angle) for angle in angles])
    return Sim3(torch.ones(len(angles)).double(), rotations, torch.zeros(len(angles), 3).double())


def rotation_about_up(angle: float) -> Tensor:
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


def test_poses_are_apart_beyond_a_twentieth_of_the_diameter() -> None:
    shifts = torch.tensor([[0.0, 0.0, 0.0], [0.04, 0.0, 0.0], [0.06, 0.0, 0.0]])
    T = Sim3(torch.ones(3).double(), torch.eye(3).double().expand(3, 3, 3), shifts.double())
    expected = [[False, False, True], [False, False, False], [True, False, False]]
    assert apart(T, POINTS, no_symmetry()).tolist() == expected


def test_distances_are_in_object_units_whatever_the_scale() -> None:
    shifts = torch.tensor([[0.0, 0.0, 0.0], [0.06, 0.0, 0.0]]).double()
    for scale in (0.05, 20.0):
        T = Sim3(torch.full((2,), scale).double(), torch.eye(3).double().expand(2, 3, 3), shifts)
        assert apart(T, POINTS, no_symmetry()).tolist() == [[False, True], [True, False]]


def test_symmetric_poses_are_one_answer() -> None:
    T = turns(0.0, math.pi, math.pi / 2)
    half = SelfSymmetry(turns(math.pi), None, torch.zeros(1))
    assert apart(T, POINTS, half).tolist() == [[False, False, True], [False, False, True], [True, True, False]]
    nearly = SelfSymmetry(turns(math.pi), None, torch.ones(1))  # the object's field does not confirm it
    assert apart(T, POINTS, nearly)[0].tolist() == [False, True, True]


def test_turns_about_an_axis_of_symmetry_are_one_answer() -> None:
    axis = SelfSymmetry(Sim3.identity()[None][:0], UP, torch.zeros(0))
    T = Sim3.cat(
        [
            turns(0.0, 0.3, 2.0),
            Sim3(torch.ones(1).double(), turns_about(UP.roll(1), 4)[1:2], torch.zeros(1, 3).double()),
        ]
    )
    assert apart(T, POINTS, axis).tolist()[0] == [False, False, False, True]


def test_leads_by_hand() -> None:
    elsewhere = torch.tensor([[False, False, True], [False, False, True], [True, True, False]])
    found = leads(torch.tensor([2.0, 1.0, 0.5]).double(), elsewhere)
    assert found.tolist() == pytest.approx([1.5, 0.5, -1.5])


def test_poses_of_one_answer_lead_over_what_is_apart_from_all_of_them() -> None:
    """0 and 1 are listed; 2 lies near 1, 3 elsewhere. Only 3 competes with the answer; 2 and 3 have their rivals."""
    elsewhere = torch.tensor(
        [[False, True, True, True], [True, False, False, True], [True, False, False, True], [True, True, True, False]]
    )
    joined = apart_from_answer(elsewhere, [0, 1])
    assert joined[:2].tolist() == [[False, False, False, True]] * 2
    assert joined[2:].tolist() == elsewhere[2:].tolist()
    found = leads(torch.tensor([2.0, 1.9, 1.8, 0.5]).double(), joined)
    assert found.tolist() == pytest.approx([1.5, 1.4, -0.2, -1.5])


def test_of_poses_that_are_about_as_likely_the_better_score_has_the_merit() -> None:
    found = merits(torch.tensor([1.0, 0.5, -3.0]).double(), torch.tensor([0.40, 0.35, 0.35]))
    assert found.argmax() == 1
    assert found[1] - found[2] == pytest.approx(3.5), "the odds count where the scores are alike"
