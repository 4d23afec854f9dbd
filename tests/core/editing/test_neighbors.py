"""Edits beside each other, and scenes whose unseen matter goes, near the origin and far from it."""

from __future__ import annotations

import torch

from regnf_core import Insertion, Sim3, compose
from regnf_core.editing.edited_scene import without_unseen
from regnf_core.fields.composite import TransformedField
from regnf_core.fields.observation import Observation, ObservedField
from regnf_core.schema.description import SURFACE, UNSEEN
from tests.core.analytic import AnalyticField, boxes, sphere

LOW = [-1.0, -1.0, -0.1]


def room() -> AnalyticField:
    return boxes(
        [(LOW, [1.0, 1.0, 0.0]), (LOW, [-0.9, 1.0, 1.0]), ([-0.2, -0.2, 0.0], [0.2, 0.2, 0.5])], [LOW, [1.0] * 3]
    )


def at(*place: float) -> Sim3:
    """T_object_scene of an object that stands at ``place``."""
    return Sim3.from_translation(-torch.tensor(place, dtype=torch.float64))


def test_neighbors_may_touch() -> None:
    ball = sphere(0.2, bounds=[[-0.3] * 3, [0.3] * 3])
    edits = [Insertion(ball, at(x, -0.6, 0.2)) for x in (-0.205, 0.2)]  # 5 mm apart, their boxes overlap
    assert len(compose(room(), edits).objects) == 2


def test_matter_that_nobody_saw_goes_far_from_the_origin_as_well() -> None:
    states = torch.full((20, 20, 11), SURFACE, dtype=torch.uint8)
    states[10:] = UNSEEN
    scene = ObservedField(room(), Observation(states, torch.tensor(LOW).double(), 0.1))
    shift = torch.tensor([448_262.25, 5_413_920.5, 112.0], dtype=torch.float64)
    far = TransformedField(scene, Sim3.from_translation(-shift))
    points = 1.6 * torch.rand(500, 3, generator=torch.Generator().manual_seed(0)).double() - 0.8
    expected = without_unseen(scene).signed_distance(points)
    assert (expected - scene.signed_distance(points)).abs().max() > 0.05
    torch.testing.assert_close(without_unseen(far).signed_distance(points + shift), expected, atol=2e-6, rtol=0.0)
