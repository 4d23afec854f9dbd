"""Scenes that know what was seen of them: surface that nobody measured neither helps nor hinders."""

from __future__ import annotations

from functools import cache

import torch

from regnf_core.fields.composite import TransformedField
from regnf_core.fields.observation import Observation, ObservedField
from regnf_core.robust.model import model_object
from regnf_core.robust.working_frame import sample_object_surface
from regnf_core.schema.description import FREE, SURFACE, UNSEEN
from tests.core.analytic import AnalyticField, boxes, chair, chair_pose, room, union
from tests.core.robust.shapes import (
    CUSHION,
    ONE_SEARCH,
    UNDER_THE_SEAT,
    detection,
    observed,
    over_closed,
    placement_error,
    random_pose,
    run,
)


def test_an_invented_part_is_left_out_where_it_is_known_and_does_not_hinder_where_it_is_not() -> None:
    scene = over_closed(UNDER_THE_SEAT)
    believed = run(scene, chair(), detection())
    T = random_pose(3, 2.5)
    moved = TransformedField(observed(scene, UNDER_THE_SEAT), T.inverse())
    box = detection()
    box = type(box)(T.apply(box.center[None])[0], box.size * T.scale, T.rotation @ box.rotation)
    result = run(moved, chair(), box)
    assert result.verdict == "registered"
    assert placement_error(result, chair_pose() @ T.inverse()) < 0.01
    assert 0.2 < result.metrics["occluded_share_object"] < 0.7
    assert believed.verdict == "registered"
    assert placement_error(believed, chair_pose()) < 0.01
    assert believed.metrics["explained_share_scene"] < 0.6
    assert result.metrics["explained_share_scene"] > 0.9


def test_matter_that_was_seen_tells_a_look_alike() -> None:
    scene = observed(over_closed(CUSHION), ([5.0] * 3, [5.1] * 3))  # all of it was seen
    result = run(scene, chair(), detection(), ONE_SEARCH)
    assert (result.verdict, result.verdict_reason) == ("rejected", "SURFACE_UNEXPLAINED")
    right = run(scene, union([chair(), boxes([CUSHION])]), detection())
    assert right.verdict == "registered"
    assert placement_error(right, chair_pose()) < 0.01


def test_what_nobody_saw_gives_no_verdict() -> None:
    scene = room(chair_pose())
    nothing = Observation(torch.full((2, 2, 2), UNSEEN, dtype=torch.uint8), scene.bounds[0], 1.0)
    result = run(ObservedField(scene, nothing), chair(), detection(), ONE_SEARCH)
    assert (result.verdict, result.verdict_reason) == ("rejected", "TOO_LITTLE_SURFACE")


# Objects that know what was seen of them: a scan's invented surface is no part of the object's model.


_VOXEL = 0.02
_BLOCK = ([-0.24, -0.26, -0.75], [0.24, 0.24, -0.44])
"""Beneath the chair: what a scan shows that was never seen from below."""


def scanned() -> AnalyticField:
    return union([chair(), boxes([_BLOCK])])


@cache
def observed_scan(unseen: bool = True) -> ObservedField:
    """The scan: everything about the chair was seen, its block was not; or nothing was, ``unseen`` being False."""
    scan = scanned()
    low, high = scan.bounds
    counts = ((high - low) / _VOXEL).round().long().tolist()
    axes = [low[k] + (torch.arange(counts[k]) + 0.5) * _VOXEL for k in range(3)]
    centers = torch.cartesian_prod(*axes)
    value = chair().signed_distance(centers)
    states = torch.where(value.abs() < 0.9 * _VOXEL, SURFACE, torch.where(value > 0, FREE, UNSEEN))
    states[boxes([_BLOCK]).signed_distance(centers) < 0.9 * _VOXEL] = UNSEEN
    if not unseen:
        states[:] = UNSEEN
    return ObservedField(scan, Observation(states.to(torch.uint8).view(counts), low, _VOXEL))


def surface_of(field: AnalyticField | ObservedField) -> torch.Tensor:
    found = sample_object_surface(field, 4000, torch.Generator().manual_seed(0))
    return found.frame.out_of(found.samples.on_surface())


def on_block(points: torch.Tensor) -> float:
    return float((boxes([_BLOCK]).signed_distance(points).abs() < 0.01).float().mean())


def test_surface_that_nobody_measured_is_no_part_of_the_model() -> None:
    assert on_block(surface_of(scanned())) > 0.2
    points = surface_of(observed_scan())
    assert on_block(points) < 0.01
    assert chair().signed_distance(points).abs().max() < 0.01
    plain, seen = (
        sample_object_surface(one, 4000, torch.Generator().manual_seed(0)) for one in (chair(), observed_scan())
    )
    assert abs(seen.frame.length / plain.frame.length - 1.0) < 0.03


def test_an_observation_that_shows_nothing_leaves_the_object_as_it_is() -> None:
    torch.testing.assert_close(surface_of(observed_scan(unseen=False)), surface_of(scanned()), rtol=0, atol=0)


def test_a_scan_is_found_by_what_was_measured_of_it() -> None:
    T = random_pose(5, 3.0)
    believed = run(room(chair_pose()), scanned(), detection(), ONE_SEARCH)
    result = run(room(chair_pose()), TransformedField(observed_scan(), T.inverse()), detection())
    assert result.verdict == "registered"
    assert placement_error(result, T @ chair_pose()) < 0.01
    assert believed.metrics["probability"] < result.metrics["probability"]


def test_the_model_of_a_scan_in_any_frame_has_the_same_size() -> None:
    T = random_pose(6, 0.05)
    here, there = model_object(observed_scan()), model_object(TransformedField(observed_scan(), T.inverse()))
    assert abs(there.frame.length / (0.05 * here.frame.length) - 1.0) < 0.03
