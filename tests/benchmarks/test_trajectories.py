"""Cameras stand in free space, look at what matters, and the trajectories differ in what they show."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.worlds.composing import bad_view, half_view, seen_points
from benchmarks.worlds.mesh_scene import MeshScene, Thing, box_thing, tile_paint
from benchmarks.worlds.rendering import intrinsics_of
from benchmarks.worlds.trajectories import WalkingGround, check_free, long_walk, look_at, orbit, pass_by, short_walk
from regnf_core.errors import DatasetError
from regnf_core.fields.composite import SurfaceSource

SIZE = (60, 80)
INTRINSICS = intrinsics_of(SIZE, 60.0)
PAINT = tile_paint((1.0, 1.0, 1.0), (0.5, 0.5, 0.5), 0.3)
FLOOR = np.array([[-2.5, -2.5, -0.1], [2.5, 2.5, 0.0]])
BOXES = (
    np.array([[-1.3, -1.2, 0.0], [-0.7, -0.4, 0.9]]),
    np.array([[0.4, 0.2, 0.0], [1.2, 0.8, 0.5]]),
    np.array([[-1.0, 0.9, 0.0], [-0.5, 1.4, 1.1]]),
)


@cache
def furnished() -> MeshScene:
    wall = box_thing([-2.7, -2.5, -0.1], [-2.5, 2.5, 2.0], PAINT)
    return MeshScene(
        [box_thing(FLOOR[0], FLOOR[1], PAINT), wall, *(box_thing(low, high, PAINT) for low, high in BOXES)]
    )


@cache
def ground() -> WalkingGround:
    return WalkingGround(furnished(), FLOOR)


def seen_share(poses: NDArray[np.float64], thing: Thing) -> float:
    """Of a thing's upper faces and sides, how much some pose sees."""
    solid = thing.solid
    assert isinstance(solid, SurfaceSource)
    points = solid.sample_surface(1500, np.random.default_rng(1))
    points = points[points[:, 2] > 0.05]
    seen = np.zeros(len(points), dtype=bool)
    for pose in poses:
        seen |= seen_points(furnished(), pose, SIZE, INTRINSICS, points)
    return float(seen.mean())


def test_look_at_by_hand_and_straight_down() -> None:
    pose = look_at(np.array([[1.0, 2.0, 3.0]]), np.array([[1.0, 5.0, 3.0]]))[0]
    np.testing.assert_allclose(pose[:3, :3], [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-12)
    np.testing.assert_array_equal(pose[:, 3], [1, 2, 3, 1])
    down = look_at(np.array([[0.0, 0.0, 2.0]]), np.zeros((1, 3)))[0, :3, :3]
    np.testing.assert_allclose(down.T @ down, np.eye(3), atol=1e-12)
    assert np.linalg.det(down) == pytest.approx(1.0)
    np.testing.assert_allclose(down[:, 2], [0, 0, -1], atol=1e-12)


@pytest.mark.parametrize("walk", [long_walk, short_walk])
def test_walks_stay_in_free_space_over_the_floor(walk: type) -> None:
    poses = walk(ground(), BOXES, 150)
    assert poses.shape == (150, 4, 4)
    positions = poses[:, :3, 3]
    assert furnished().signed_distance(positions).min() > 0.15
    assert ((positions[:, :2] > FLOOR[0, :2]) & (positions[:, :2] < FLOOR[1, :2])).all()
    assert np.linalg.norm(np.diff(positions[:70, :2], axis=0), axis=1).max() < 0.5  # walked, not jumped
    check_free(furnished(), poses)


def test_a_long_walk_sees_all_and_a_short_one_leaves_out() -> None:
    long, short = long_walk(ground(), BOXES, 120), short_walk(ground(), BOXES, 40)
    things = furnished().things[2:]
    assert min(seen_share(long, thing) for thing in things) > 0.97
    shares = [seen_share(short, thing) for thing in things]
    assert max(shares) < 0.9
    assert min(shares) > 0.3


def test_orbits_show_the_whole_from_above_the_floor() -> None:
    bounds = BOXES[1] + 0.0
    corners = np.stack(np.meshgrid(*bounds.T, indexing="ij"), axis=-1).reshape(-1, 3)
    for poses in (
        orbit(bounds, 60, half_view(SIZE, INTRINSICS), 0.0),
        pass_by(bounds, 20, half_view(SIZE, INTRINSICS), 0.0),
    ):
        assert poses[:, 2, 3].min() > 0.1
        for pose in poses:
            u, v, z = INTRINSICS @ ((corners - pose[:3, 3]) @ pose[:3, :3]).T
            assert (z > 0.0).all()
            assert ((u / z > 0.0) & (u / z < 80.0) & (v / z > 0.0) & (v / z < 60.0)).all()
    angles = np.arctan2(*(poses[:, :2, 3] - bounds.mean(axis=0)[:2]).T[::-1])
    assert np.degrees(np.ptp(angles)) == pytest.approx(130.0)


def test_orbits_have_four_heights_and_go_all_round() -> None:
    poses = orbit(BOXES[1], 60, half_view(SIZE, INTRINSICS), 0.0)
    assert len(poses) == 60
    heights = np.unique(np.round(poses[:, 2, 3], 6))
    assert len(heights) == 4
    for height in heights:
        ring = poses[np.isclose(poses[:, 2, 3], height)][:, :2, 3] - BOXES[1].mean(axis=0)[:2]
        angles = np.sort(np.arctan2(ring[:, 1], ring[:, 0]))
        np.testing.assert_allclose(np.diff(angles), 2 * np.pi / len(ring), atol=1e-9)


def test_a_bad_view_is_free_shows_the_thing_and_sees_less_of_it_than_others() -> None:
    thing = furnished().things[2]
    pose = bad_view(furnished(), thing, SIZE, INTRINSICS, 0.0)
    assert furnished().signed_distance(pose[None, :3, 3]).min() >= 0.15
    share = seen_share(pose[None], thing)
    center = BOXES[0].mean(axis=0)
    distance = float(np.linalg.norm(pose[:3, 3] - center))
    good = look_at(center + distance * np.array([[0.6, 0.6, 0.53]]), center[None])
    assert 0.1 < share < 0.8 * seen_share(good, thing)


def test_a_camera_in_matter_is_refused() -> None:
    inside = look_at(np.array([[-1.0, -0.8, 0.4]]), np.zeros((1, 3)))
    with pytest.raises(DatasetError) as refused:
        check_free(furnished(), inside)
    assert refused.value.reason == "DATASET_NO_FREE_PATH"
    crammed = MeshScene([box_thing([-2.5, -2.5, -0.1], [2.5, 2.5, 1.0], PAINT)])
    with pytest.raises(DatasetError, match="no room to walk") as refused:
        WalkingGround(crammed, FLOOR)
    assert refused.value.reason == "DATASET_NO_FREE_PATH"


def test_the_shortest_way_goes_round_the_furniture() -> None:
    start, end = ground().nearest(np.array([[-1.0, -1.6], [-1.0, 0.3]]))
    path = ground().shortest(start, end)
    np.testing.assert_array_equal(path[[0, -1]], [start, end])
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() < 0.15
    assert ground().clearance_along(path).min() >= 0.2
    # Straight on would lead through the box. Past its side at 20 cm: .6 m to the side and back, within the grid's ways.
    length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    assert np.linalg.norm(end - start) + 0.2 < length < 2.9
