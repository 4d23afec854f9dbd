"""Random worlds: the same for a seed, and things stand on something without going through each other."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest

from benchmarks.random_worlds.mesh import Array, Mesh, ball, block, box, together
from benchmarks.random_worlds.models import PARTS, Catalog, Model, families, part_of, part_of_world, seeds_of
from benchmarks.random_worlds.placing import GAP_M, Placed, collides, rest
from benchmarks.random_worlds.walks import KINDS, Kind, make_world

FLOOR = Placed(None, np.eye(4), box((-2.0, -2.0, -0.1), (2.0, 2.0, 0.0)))
UP = np.eye(4)


def cube(edge: float = 0.2) -> Model:
    return Model("cube", block((0.0, 0.0, edge / 2.0), (edge, edge, edge)))


@pytest.mark.parametrize("kind", KINDS)
def test_one_seed_is_one_world_whose_things_go_through_nothing_and_float_nowhere(kind: Kind) -> None:
    made, again = (make_world(3, Catalog(), kind) for _ in range(2))
    assert len(again.things) == len(made.things) >= 3
    for one, other in zip(made.things, again.things, strict=True):
        assert np.array_equal(one.mesh.vertices, other.mesh.vertices)
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


def test_one_thing_within_another_collides_with_it() -> None:
    host = Placed(None, np.eye(4), block((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)))
    assert collides(ball((0.0, 0.0, 0.0), 0.1), [host])
    assert not collides(ball((0.0, 0.0, 0.8), 0.1), [host])


# Which names and seeds belong to train, validation and test.


def test_a_name_always_belongs_to_the_same_part() -> None:
    assert [part_of(name) for name in ("teapot", "chair_pine", "mini_fridge")] == ["train", "test", "train"]


def test_look_alikes_are_of_one_family() -> None:
    family = families(["arm_chair", "arm_chair_nopillow", "arm", "armada", "stool"])
    assert family == {
        **dict.fromkeys(("arm_chair", "arm_chair_nopillow", "arm"), "arm"),
        **{name: name for name in ("armada", "stool")},
    }


def test_every_seed_is_of_one_part_and_each_part_has_its_share() -> None:
    parts = [part_of_world(seed) for seed in range(2000)]
    for part, least in zip(PARTS, (0.4, 0.2, 0.25), strict=True):
        assert parts.count(part) >= least * len(parts)
        assert list(islice(seeds_of(part), 5)) == [seed for seed, own in enumerate(parts) if own == part][:5]


# What can be seen of a model from outside.


def seen(mesh: Mesh) -> Array:
    return Model("thing", mesh).surface


def test_what_lies_within_another_part_is_not_seen() -> None:
    outer, inner = box([-1.0] * 3, [1.0] * 3), box([-0.5] * 3, [0.5] * 3)
    found = seen(together(outer, inner))
    assert len(found) > 1_000
    assert (np.abs(found).max(axis=1) > 0.999).all()


def test_a_cup_is_seen_within() -> None:
    walls = [box([-1.0, -1.0, 0.0], [1.0, -0.9, 2.0]), box([-1.0, 0.9, 0.0], [1.0, 1.0, 2.0])]
    walls += [box([-1.0, -0.9, 0.0], [-0.9, 0.9, 2.0]), box([0.9, -0.9, 0.0], [1.0, 0.9, 2.0])]
    found = seen(together(*walls, box([-0.9, -0.9, 0.0], [0.9, 0.9, 0.1])))
    within = (np.abs(found[:, :2]) < 0.95).all(axis=1) & (found[:, 2] > 0.05) & (found[:, 2] < 1.99)
    assert within.mean() > 0.3
