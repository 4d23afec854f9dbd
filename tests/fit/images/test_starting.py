"""Which shape a field starts from: what the depths, or the cameras without them, say of a room and of a thing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from regnf_data.posed_images import PosedImages
from regnf_fit.images.preparation import prepare
from regnf_fit.options import Start
from tests.fit.images import scenes

RADIUS = 0.5


def hollow(images: PosedImages, start: Start = "auto") -> bool:
    return prepare(images, start, np.random.default_rng(0)).start.hollow


def of_ball(side: float) -> PosedImages:
    """Views from outside the bounds of a ball in their middle: its outside (side -1), or, as if the near half were cut
    away, the inside of its far half (side 1)."""
    images = scenes.images(count=12)
    height, width = images.size
    rows, columns = np.indices((height, width)) + 0.5
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(images.intrinsics[0]).T
    center = images.bounds.mean(axis=0)
    depths = []
    for pose in images.T_world_camera:
        directions, origin = rays @ pose[:3, :3].T, pose[:3, 3] - center
        a, b, c = (directions**2).sum(-1), directions @ origin, origin @ origin - RADIUS**2
        root = np.sqrt(np.maximum(b * b - a * c, 0.0))
        depths.append(np.where(b * b > a * c, (-b + side * root) / a, 0.0))
    stacked = np.stack(depths).astype(np.float32)
    return replace(images, depths=stacked, masks=None)


@pytest.mark.parametrize(("side", "is_room"), [(-1.0, False), (1.0, True)])
def test_depths_tell_a_room_from_a_thing_wherever_the_cameras_stand(side: float, is_room: bool) -> None:
    images = of_ball(side)
    cameras = images.T_world_camera[:, :3, 3]
    assert ((cameras < images.bounds[0]) | (cameras > images.bounds[1])).any(axis=1).all()
    assert hollow(images) == is_room
    assert hollow(images, "room")
    assert not hollow(images, "object")


def test_two_things_side_by_side_are_no_room() -> None:
    assert not hollow(scenes.images(count=12))


def test_surface_seen_often_counts_once() -> None:
    """Ten more cameras before one spot of a room's wall, which lies before the middle, change nothing."""
    images = of_ball(1.0)
    assert images.depths is not None
    spot = np.zeros_like(images.depths[:1])
    row, column = (side // 2 for side in images.size)
    # a chip of matter near the camera, on this side of the middle
    spot[0, row - 1 : row + 2, column - 1 : column + 2] = 1.0
    often = [np.concatenate([one, np.repeat(one[:1], 200, axis=0)]) for one in (images.colors, images.intrinsics)]
    poses = np.concatenate([images.T_world_camera, np.repeat(images.T_world_camera[:1], 200, axis=0)])
    depths = np.concatenate([images.depths, np.repeat(spot, 200, axis=0)])
    assert hollow(replace(images, colors=often[0], intrinsics=often[1], T_world_camera=poses, depths=depths))


@pytest.mark.parametrize(("distance", "is_room"), [(1.6, False), (0.3, True)])
def test_without_depths_the_cameras_places_tell(distance: float, is_room: bool) -> None:
    images = scenes.images(count=8)
    poses = images.T_world_camera.copy()
    poses[:, :3, 3] *= distance / 1.6
    assert hollow(replace(images, depths=None, masks=None, T_world_camera=poses)) == is_room
