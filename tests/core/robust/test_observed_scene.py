"""Scenes that know what was seen of them: surface that nobody measured neither helps nor hinders."""

from __future__ import annotations

import torch

from regnf_core.fields.observation import Observation, ObservedField
from regnf_core.fields.transformed import TransformedField
from regnf_core.geometry.sim3 import Sim3
from regnf_core.registration import register
from regnf_core.schema.observation_grid import FREE, SURFACE, UNSEEN
from tests.core.analytic import AnalyticField, boxes, chair, chair_pose, room, seen_from, union
from tests.core.robust.shapes import ROBUST, detection, placement_error, random_pose

_UNDER_THE_SEAT = ([-0.26, -0.27, -0.41], [0.26, 0.27, -0.03])
_CUSHION = ([-0.20, -0.20, 0.02], [0.16, 0.14, 0.12])
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


def test_an_invented_part_hinders_only_those_who_believe_it() -> None:
    scene = over_closed(_UNDER_THE_SEAT)
    believed = register(scene, chair(), detection(), ROBUST, clouds=False)
    T = random_pose(3, 2.5)
    moved = TransformedField(observed(scene, _UNDER_THE_SEAT), T.inverse())
    box = detection()
    box = type(box)(T.apply(box.center[None])[0], box.size * T.scale, T.rotation @ box.rotation)
    result = register(moved, chair(), box, ROBUST)
    assert result.verdict == "registered"
    assert placement_error(result, chair_pose() @ T.inverse()) < 0.01
    assert 0.2 < result.metrics["occluded_share_object"] < 0.7
    assert believed.metrics["verdict_margin"] < 0.1
    assert believed.metrics["explained_share_scene"] < 0.6
    assert result.metrics["explained_share_scene"] > 0.9


def test_matter_that_was_seen_tells_a_look_alike() -> None:
    scene = over_closed(_CUSHION)
    nothing: tuple[list[float], list[float]] = ([5.0] * 3, [5.1] * 3)
    result = register(observed(scene, nothing), chair(), detection(), ROBUST, clouds=False)
    assert (result.verdict, result.verdict_reason) == ("rejected", "SURFACE_UNEXPLAINED")
    cushioned = union([chair(), boxes([_CUSHION])])
    right = register(observed(scene, nothing), cushioned, detection(), ROBUST)
    assert right.verdict == "registered"
    assert placement_error(right, chair_pose()) < 0.01


def test_what_nobody_saw_gives_no_verdict() -> None:
    scene = room(chair_pose())
    everything = ([-2.0] * 3, [2.0] * 3)
    box = detection()
    seen = observed(scene, everything)
    result = register(seen, chair(), box, ROBUST, clouds=False)
    assert result.verdict == "rejected"
    assert isinstance(result.T_object_scene, Sim3)
