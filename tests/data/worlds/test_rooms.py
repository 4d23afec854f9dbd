"""Random worlds: the same for a seed, and things stand on something without going through each other."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest

from benchmarks.random_worlds.mesh import ball, block, box, turned
from benchmarks.random_worlds.models import Catalog, Model
from benchmarks.random_worlds.placing import GAP_M, Placed, collides, rest, resting_turns, touching
from benchmarks.random_worlds.walks import KINDS, Kind, World, make_world

FLOOR = Placed(None, np.eye(4), box((-2.0, -2.0, -0.1), (2.0, 2.0, 0.0)))
UP = np.eye(4)


@cache
def world(kind: Kind) -> World:
    return make_world(3, Catalog(), kind)


def cube(edge: float = 0.2) -> Model:
    return Model("cube", block((0.0, 0.0, edge / 2.0), (edge, edge, edge)))


@pytest.mark.parametrize("kind", KINDS)
def test_one_seed_is_one_world(kind: Kind) -> None:
    again = make_world(3, Catalog(), kind)
    assert len(again.things) == len(world(kind).things) >= 3
    for one, other in zip(world(kind).things, again.things, strict=True):
        assert np.array_equal(one.mesh.vertices, other.mesh.vertices)


@pytest.mark.parametrize("kind", KINDS)
def test_things_go_through_nothing_and_float_nowhere(kind: Kind) -> None:
    made = world(kind)
    for number, thing in enumerate(made.things):
        others = [*made.fixed, *made.things[:number]]
        assert not collides(thing.mesh, others)
        # moved down by a little more than the gap, it goes through what carries it
        assert collides(thing.mesh.shifted(0.0, 0.0, -3.0 * GAP_M), others)


def test_a_thing_falls_on_what_lies_beneath() -> None:
    first = rest(cube(), UP, np.array([0.0, 0.0, 0.0]), [FLOOR])
    assert first is not None
    assert first.mesh.bounds[0, 2] == pytest.approx(GAP_M, abs=1e-5)
    second = rest(cube(), UP, np.array([0.05, 0.0, 0.2 + GAP_M]), [FLOOR, first])
    assert second is not None
    assert second.mesh.bounds[0, 2] == pytest.approx(0.2 + 2.0 * GAP_M, abs=1e-5)


def test_a_thing_does_not_stay_where_its_weight_is_not_carried() -> None:
    first = rest(cube(), UP, np.array([0.0, 0.0, 0.0]), [FLOOR])
    assert first is not None
    assert rest(cube(), UP, np.array([0.13, 0.0, 0.2 + GAP_M]), [FLOOR, first]) is None


def test_a_thing_that_is_pushed_stops_where_it_touches() -> None:
    wall = Placed(None, np.eye(4), box((1.0, -2.0, 0.0), (1.1, 2.0, 2.0)))
    thing = rest(cube(), UP, np.array([0.0, 0.0, 0.0]), [FLOOR])
    assert thing is not None
    pushed = touching(thing, np.array([1.0, 0.0, 0.0]), [FLOOR, wall], 3.0, 0.01)
    assert pushed.mesh.bounds[1, 0] == pytest.approx(0.99, abs=1e-5)
    assert touching(thing, np.array([1.0, 0.0, 0.0]), [FLOOR, wall], 0.5, 0.01) is thing


def test_one_thing_within_another_collides_with_it() -> None:
    host = Placed(None, np.eye(4), block((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)))
    assert collides(ball((0.0, 0.0, 0.0), 0.1), [host])
    assert not collides(ball((0.0, 0.0, 0.8), 0.1), [host])


def test_a_bottle_lies_on_its_side() -> None:
    bottle = Model("bottle", turned([(0.0, 0.0), (0.04, 0.0), (0.04, 0.3), (0.0, 0.3)]))
    turn = resting_turns(bottle, np.random.default_rng(1), lying=True)
    height = np.ptp(bottle.mesh.moved(turn).vertices[:, 2])
    assert math.isclose(height, 0.08, rel_tol=0.05) or math.isclose(height, 0.3, rel_tol=0.05)
