"""Which placements stand together, against all sets written out, and against boxes whose overlap is known."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
import trimesh
from scipy.sparse.csgraph import connected_components

from regnf_core.geometry.sim3 import Sim3
from regnf_core.population.consistency import conflicts, distinct, together, within_boundary
from regnf_core.population.placements import Placement
from regnf_core.population.proposals import BoundaryPlane, SceneSurface
from tests.core.population.rooms import library

SPACING = 0.02


def placement(
    probability: float, explains: range, number: int = 0, at: tuple[float, float, float] = (0, 0, 0)
) -> Placement:
    T = Sim3(torch.tensor(1.0).double(), torch.eye(3).double(), -torch.tensor(at).double())
    numbers = np.array(list(explains), np.int64)
    return Placement(number, f"object {number}", T, probability, "registered", "SURFACES_AGREE", numbers)


def excluding(count: int, *pairs: tuple[int, int]) -> np.ndarray:
    found = np.zeros((count, count), bool)
    for a, b in pairs:
        found[a, b] = found[b, a] = True
    return found


def test_two_that_exclude_each_other_share_the_odds() -> None:
    both = [placement(0.9, range(100)), placement(0.9, range(50, 150), 1)]
    chosen, likely = together(both, excluding(2, (0, 1)), 0.8)
    assert likely == pytest.approx([9 / 19, 9 / 19])  # odds 9 each, and 1 for none
    assert chosen == []


def test_a_large_object_is_not_given_up_for_small_ones_on_its_parts() -> None:
    large, small = placement(0.95, range(1000)), placement(0.95, range(100), 1)
    other = placement(0.95, range(200, 300), 1)
    chosen, likely = together([large, small, other], excluding(3, (0, 1), (0, 2)), 0.8)
    part = 19 * 0.1**2  # the odds of each small one
    total = (1 + part) ** 2 + 19
    assert likely == pytest.approx([19 / total, part * (1 + part) / total, part * (1 + part) / total])
    assert chosen == [0]


def test_a_placement_without_conflict_keeps_its_probability() -> None:
    alone = [placement(0.9, range(100)), placement(0.3, range(200, 300), 1)]
    chosen, likely = together(alone, excluding(2), 0.8)
    assert likely == pytest.approx([0.9, 0.3])
    assert chosen == [0]


@pytest.mark.parametrize("seed", range(8))
def test_shares_and_the_best_set_are_those_of_all_sets(seed: int) -> None:
    random = np.random.default_rng(seed)
    count = 8
    many = [
        placement(p, range(int(n)))
        for p, n in zip(random.uniform(0.5, 0.999, count), random.integers(50, 900, count), strict=True)
    ]
    excluded = np.triu(random.random((count, count)) < 0.2, 1)
    excluded |= excluded.T
    chosen, likely = together(many, excluded, 0.8)
    weights, held = [], []
    label = connected_components(excluded)[1]
    largest = [max(len(one.explains) for one, group in zip(many, label, strict=True) if group == own) for own in label]
    odds = np.array([one.probability / (1 - one.probability) for one in many])
    alone = np.bincount(label)[label] == 1
    odds *= np.where(alone, 1.0, (np.array([len(one.explains) for one in many]) / largest) ** 2)
    for members in itertools.product([False, True], repeat=count):
        numbers = np.flatnonzero(members)
        if not excluded[np.ix_(numbers, numbers)].any():
            weights.append(odds[numbers].prod())
            held.append(members)
    total = np.array(weights) / sum(weights)
    assert likely == pytest.approx(total @ np.array(held, float), abs=1e-9)
    worth = np.array([len(one.explains) for one in many]) * (likely - 0.8)
    assert worth[chosen].sum() == pytest.approx(max((worth * np.array(one)).sum() for one in held), abs=1e-9)


def test_of_the_same_object_on_the_same_surface_the_most_probable_is_kept() -> None:
    one, twin, other = placement(0.8, range(100)), placement(0.95, range(40, 140)), placement(0.7, range(40, 140), 1)
    assert distinct([one, twin, other]) == [twin, other]


def test_boxes_that_reach_into_each_other_exclude_each_other_and_boxes_that_touch_do_not() -> None:
    cubes = library(cube=trimesh.creation.box((1.0, 1.0, 1.0)), slab=trimesh.creation.box((1.0, 1.0, 0.2)))
    base = placement(0.9, range(100))

    def excluded(z: float) -> bool:
        return bool(conflicts([base, placement(0.9, range(200, 300), 1, (0.0, 0.0, z))], cubes, SPACING)[0, 1])

    assert not excluded(0.6)  # touches
    assert not excluded(0.6 - 0.5 * SPACING)
    assert excluded(0.6 - 3.0 * SPACING)
    assert excluded(0.0)  # wholly inside


def test_an_object_behind_the_floor_is_not_within_the_boundary() -> None:
    cubes = library(cube=trimesh.creation.box((1.0, 1.0, 1.0)))
    floor = SceneSurface(np.zeros((0, 3)), np.zeros((0, 3)), SPACING, [BoundaryPlane(np.array([0.0, 0.0, 1.0]), 0.0)])
    assert within_boundary(placement(0.9, range(9), at=(0, 0, 0.5)), cubes, floor)
    assert within_boundary(placement(0.9, range(9), at=(0, 0, 0.5 - 0.5 * SPACING)), cubes, floor)
    assert not within_boundary(placement(0.9, range(9), at=(0, 0, 0.5 - 3 * SPACING)), cubes, floor)
