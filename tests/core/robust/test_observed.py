"""Fields that know what was seen of them: surface that nobody measured neither helps nor hinders."""

from __future__ import annotations

from functools import cache

import torch

from regnf_core.fields.composite import TransformedField
from regnf_core.fields.observation import ObservedField
from regnf_core.geometry.sim3 import Sim3
from regnf_core.library import register
from regnf_core.robust.model import model_object
from regnf_core.robust.working_frame import sample_object_surface
from tests.core.analytic import AnalyticField, boxes, chair, chair_pose, room, union
from tests.core.robust.seen_in_part import CUSHION, UNDER_THE_SEAT, observed, over_closed, seen_but_for
from tests.core.robust.shapes import ONE_SEARCH, ROBUST, detection, placement_error, random_pose


def test_an_invented_part_is_left_out_where_it_is_known_and_does_not_hinder_where_it_is_not() -> None:
    scene = over_closed(UNDER_THE_SEAT)
    believed = register(scene, chair(), detection(), ROBUST, clouds=False)
    T = random_pose(3, 2.5)
    moved = TransformedField(observed(scene, UNDER_THE_SEAT), T.inverse())
    box = detection()
    box = type(box)(T.apply(box.center[None])[0], box.size * T.scale, T.rotation @ box.rotation)
    result = register(moved, chair(), box, ROBUST, clouds=False)
    assert result.verdict == "registered"
    assert placement_error(result, chair_pose() @ T.inverse()) < 0.01
    assert 0.2 < result.metrics["occluded_share_object"] < 0.7
    assert believed.verdict == "registered"
    assert placement_error(believed, chair_pose()) < 0.01
    assert believed.metrics["explained_share_scene"] < 0.6
    assert result.metrics["explained_share_scene"] > 0.9


def test_matter_that_was_seen_tells_a_look_alike() -> None:
    scene = observed(over_closed(CUSHION), ([5.0] * 3, [5.1] * 3))  # all of it
    result = register(scene, chair(), detection(), ONE_SEARCH, clouds=False)
    assert (result.verdict, result.verdict_reason) == ("rejected", "SURFACE_UNEXPLAINED")
    cushioned = union([chair(), boxes([CUSHION])])
    right = register(scene, cushioned, detection(), ROBUST, clouds=False)
    assert right.verdict == "registered"
    assert placement_error(right, chair_pose()) < 0.01


def test_what_nobody_saw_gives_no_verdict() -> None:
    scene = room(chair_pose())
    everything = ([-2.0] * 3, [2.0] * 3)
    result = register(observed(scene, everything), chair(), detection(), ONE_SEARCH, clouds=False)
    assert (result.verdict, result.verdict_reason) == ("rejected", "TOO_LITTLE_SURFACE")
    assert isinstance(result.T_object_scene, Sim3)


# Objects: a scan of the chair, closed over beneath.

_BLOCK = boxes([([-0.24, -0.26, -0.75], [0.24, 0.24, -0.44])])
"""Beneath the chair: what a scan shows that was never seen from below."""


def scanned() -> AnalyticField:
    return union([chair(), _BLOCK])


@cache
def scan(nothing: bool = False) -> ObservedField:
    """Everything about the chair was seen, its block was not; or ``nothing`` was."""
    return seen_but_for(scanned(), chair(), boxes([([-2.0] * 3, [2.0] * 3)]) if nothing else _BLOCK)


def surface_of(field: AnalyticField | ObservedField) -> torch.Tensor:
    found = sample_object_surface(field, 4000, torch.Generator().manual_seed(0))
    return found.frame.out_of(found.samples.on_surface())


def on_block(points: torch.Tensor) -> float:
    return float((_BLOCK.signed_distance(points).abs() < 0.01).float().mean())


def test_surface_that_nobody_measured_is_no_part_of_the_model() -> None:
    assert on_block(surface_of(scanned())) > 0.2
    points = surface_of(scan())
    assert on_block(points) < 0.01
    assert chair().signed_distance(points).abs().max() < 0.01
    plain, seen = (sample_object_surface(one, 4000, torch.Generator().manual_seed(0)) for one in (chair(), scan()))
    assert abs(seen.frame.length / plain.frame.length - 1.0) < 0.03


def test_an_observation_that_shows_nothing_leaves_the_object_as_it_is() -> None:
    torch.testing.assert_close(surface_of(scan(nothing=True)), surface_of(scanned()), rtol=0, atol=0)


def test_a_scan_is_found_by_what_was_measured_of_it() -> None:
    T = random_pose(5, 3.0)
    scene, box = room(chair_pose()), detection()
    believed = register(scene, scanned(), box, ONE_SEARCH, clouds=False)
    result = register(scene, TransformedField(scan(), T.inverse()), box, ROBUST, clouds=False)
    assert result.verdict == "registered"
    assert placement_error(result, T @ chair_pose()) < 0.01
    assert believed.metrics["probability"] < result.metrics["probability"]


def test_the_model_of_a_scan_in_any_frame_has_the_same_size() -> None:
    T = random_pose(6, 0.05)
    here, there = model_object(scan()), model_object(TransformedField(scan(), T.inverse()))
    assert abs(there.frame.length / (0.05 * here.frame.length) - 1.0) < 0.03
