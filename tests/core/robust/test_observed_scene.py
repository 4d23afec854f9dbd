"""Scenes that know what was seen of them: surface that nobody measured neither helps nor hinders."""

from __future__ import annotations

from regnf_core.fields.composite import TransformedField
from regnf_core.geometry.sim3 import Sim3
from regnf_core.library import register
from tests.core.analytic import boxes, chair, chair_pose, room, union
from tests.core.robust.seen_in_part import CUSHION, UNDER_THE_SEAT, observed, over_closed
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
    scene = over_closed(CUSHION)
    nothing: tuple[list[float], list[float]] = ([5.0] * 3, [5.1] * 3)
    result = register(observed(scene, nothing), chair(), detection(), ONE_SEARCH, clouds=False)
    assert (result.verdict, result.verdict_reason) == ("rejected", "SURFACE_UNEXPLAINED")
    cushioned = union([chair(), boxes([CUSHION])])
    right = register(observed(scene, nothing), cushioned, detection(), ROBUST, clouds=False)
    assert right.verdict == "registered"
    assert placement_error(right, chair_pose()) < 0.01


def test_what_nobody_saw_gives_no_verdict() -> None:
    scene = room(chair_pose())
    everything = ([-2.0] * 3, [2.0] * 3)
    result = register(observed(scene, everything), chair(), detection(), ONE_SEARCH, clouds=False)
    assert (result.verdict, result.verdict_reason) == ("rejected", "TOO_LITTLE_SURFACE")
    assert isinstance(result.T_object_scene, Sim3)
