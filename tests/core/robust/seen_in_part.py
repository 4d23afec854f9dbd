"""A room with a chair, of which all was observed but one part of the chair."""

from __future__ import annotations

import torch

from regnf_core.fields.observation import Observation, ObservedField
from regnf_core.schema.description import FREE, SURFACE, UNSEEN
from tests.core.analytic import AnalyticField, boxes, chair_pose, room, seen_from, union

UNDER_THE_SEAT = ([-0.26, -0.27, -0.41], [0.26, 0.27, -0.03])
CUSHION = ([-0.20, -0.20, 0.02], [0.16, 0.14, 0.12])
_VOXEL = 0.02


def over_closed(part: tuple[list[float], list[float]]) -> AnalyticField:
    """The room, with more matter in ``part`` of the chair, its frame."""
    return union([room(chair_pose()), seen_from(boxes([part]), chair_pose())])


def observed(scene: AnalyticField, part: tuple[list[float], list[float]]) -> ObservedField:
    """Of ``scene`` everything was seen but ``part`` of the chair, its frame."""
    low, high = scene.bounds
    counts = ((high - low) / _VOXEL).round().long().tolist()
    axes = [low[k] + (torch.arange(counts[k]) + 0.5) * _VOXEL for k in range(3)]
    centers = torch.cartesian_prod(*axes)
    value = scene.signed_distance(centers)
    states = torch.where(value.abs() < 0.9 * _VOXEL, SURFACE, torch.where(value > 0, FREE, UNSEEN))
    hidden = seen_from(boxes([part]), chair_pose()).signed_distance(centers) < 0.9 * _VOXEL
    states[hidden] = UNSEEN
    return ObservedField(scene, Observation(states.to(torch.uint8).view(counts), low, _VOXEL))
