"""How far from measured surface space begins to be known free, by layers of voxels; and what that decides."""

from __future__ import annotations

import pytest
import torch

from regnf_core.fields.observation import Observation, ObservedField
from regnf_core.robust.constants import OCCLUSION
from regnf_core.robust.working_frame import WorkingFrame, WorkingObservation, clearance, sample_object_surface
from regnf_core.schema.description import FREE, SURFACE, UNSEEN
from tests.core.analytic import boxes

COUNT, VOXEL, MIDDLE = 40, 0.05, 20
TOP = MIDDLE * VOXEL


def layers(measured: int, margin: int) -> Observation:
    """A surface in so many layers below z = 0, so many unseen ones above it, free space above those."""
    states = torch.full((COUNT, COUNT, COUNT), UNSEEN, dtype=torch.uint8)
    states[:, :, MIDDLE - measured : MIDDLE] = SURFACE
    states[:, :, MIDDLE + margin :] = FREE
    return Observation(states, torch.full((3,), -TOP, dtype=torch.float64), VOXEL)


@pytest.mark.parametrize(
    ("measured", "margin", "expected"),
    [(1, 0, 2.0), (1, 1, 2.0), (1, 3, 4.0), (4, 2, 6.0), (1, 20, OCCLUSION.max_clearance)],
)
def test_the_deepest_measured_layer_tells(measured: int, margin: int, expected: float) -> None:
    """The nearest free voxel lies as many layers above the deepest measured one."""
    assert clearance(layers(measured, margin)) == expected


def test_a_quantile_of_the_layers() -> None:
    """A tenth of the measured voxels lie deeper than the others, 7 layers from free space instead of 3."""
    observation = layers(1, 2)
    observation.states[: COUNT // 20, :, MIDDLE - 5 : MIDDLE - 1] = UNSEEN
    observation.states[: COUNT // 20, :, MIDDLE - 5] = SURFACE
    assert clearance(observation) == 3.0


def test_without_a_measured_surface_it_is_the_least() -> None:
    observation = layers(1, 2)
    observation.states[observation.states == SURFACE] = UNSEEN
    assert clearance(observation) == OCCLUSION.min_clearance


def test_surface_within_a_noisy_layer_was_seen_from_above_and_not_from_below() -> None:
    seen = WorkingObservation(layers(4, 2), WorkingFrame(torch.zeros(3, dtype=torch.float64), 2.0))
    points = torch.tensor([[0.0, 0.0, -2.0 * VOXEL]]).expand(2, 3) / 2.0
    normals = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    assert seen.faces_unobserved(points, normals).tolist() == [False, True]


def test_the_model_of_a_noisy_scan_keeps_the_surface_that_was_seen() -> None:
    """A plate seen from above, half of it by noisy depths: all of its upper side is the model, and its lower side,
    which nobody saw, is no part of it."""
    observation = layers(4, 2)
    observation.states[MIDDLE:] = layers(2, 0).states[MIDDLE:]
    plate = ObservedField(boxes([([-0.5, -0.5, -6.0 * VOXEL], [0.5, 0.5, -1.5 * VOXEL])]), observation)
    found = sample_object_surface(plate, 4000, torch.Generator().manual_seed(0))
    points = found.frame.out_of(found.samples.on_surface())
    assert (points[:, 2] > -2.0 * VOXEL).float().mean() > 0.9
    assert 0.4 < (points[:, 0] < 0.0).float().mean() < 0.6
