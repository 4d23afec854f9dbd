"""What images ask of a fit: where there is detail, the shape to start from, the size of the grid."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from regnf_core.geometry.box import OrientedBox
from regnf_data.posed_images import PosedImages
from regnf_fit.images.fit import grid_of
from regnf_fit.images.preparation import in_boxes, prepare, uneven
from regnf_fit.options import Start
from tests.fit.images import scenes

SIZE = 5.0  # cells of 10 cm


def plane(count: int, generator: torch.Generator) -> Tensor:
    """Points of a slanting plane, 2 m wide."""
    uv = 2.0 * torch.rand(count, 2, generator=generator) - 1.0
    return torch.stack([uv[:, 0], uv[:, 1], 0.3 * uv[:, 0] + 0.2 * uv[:, 1] + 0.01], 1)


def test_planes_are_flat_and_small_balls_are_not() -> None:
    generator = torch.Generator().manual_seed(0)
    floor = plane(40_000, generator)
    ball = 0.045 * torch.nn.functional.normalize(torch.randn(2000, 3, generator=generator), dim=1)
    found = uneven(torch.cat([floor, ball + torch.tensor([0.55, 0.55, 1.05])]), torch.zeros(42_000), SIZE)
    assert not found[:40_000].any()
    assert found[40_000:].float().mean() > 0.9


def test_noise_that_is_known_is_no_detail() -> None:
    generator = torch.Generator().manual_seed(1)
    noise = 0.02 * torch.randn(40_000, generator=generator)
    points = plane(40_000, generator)
    points[:, 2] += noise
    assert uneven(points, torch.zeros(40_000), SIZE).float().mean() > 0.9
    assert uneven(points, torch.full((40_000,), 0.02), SIZE).float().mean() < 0.05


def test_no_points_and_lone_points_have_no_detail() -> None:
    assert uneven(torch.zeros(0, 3), torch.zeros(0), SIZE).shape == (0,)
    assert not uneven(torch.tensor([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]]), torch.zeros(2), SIZE).any()


def test_boxes_are_a_little_grown() -> None:
    box = OrientedBox(torch.zeros(3).double(), torch.ones(3).double(), torch.eye(3).double())
    points = torch.tensor([[0.0, 0.0, 0.0], [0.54, 0.0, 0.0], [0.7, 0.0, 0.0]])
    assert in_boxes([box], points).tolist() == [True, True, False]
    assert not in_boxes([], points).any()


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


def chosen(images: PosedImages, table_log2: int | None = None) -> tuple[int, int, int]:
    """Levels, nodes along an edge of the finest, log2 of the entries a level."""
    grid = grid_of(prepare(images, "auto", np.random.default_rng(0)), table_log2)
    return grid.levels, round(grid.scales()[-1]) + 1, grid.log2_table_size


def occupied(images: PosedImages, edge: float) -> int:
    """Cells of this edge with a measured point in them."""
    assert images.depths is not None
    rows, columns = np.indices(images.size) + 0.5
    cells = []
    for depth, camera, pose in zip(images.depths, images.intrinsics, images.T_world_camera, strict=True):
        rays = np.einsum("ij,jhw->hwi", np.linalg.inv(camera), np.stack([columns, rows, np.ones_like(rows)]))
        points = np.einsum("ij,hwj->hwi", pose[:3, :3], depth[..., None] * rays) + pose[:3, 3]
        cells.append(np.floor(points[depth > 0.0] / edge))
    return len(np.unique(np.concatenate(cells), axis=0))


def test_coarse_pixels_and_colors_alone_take_the_smallest_grid() -> None:
    assert chosen(scenes.images()) == (8, 512, 15)
    alone = replace(scenes.images(count=2), depths=None)
    assert [chosen(alone, log2) for log2 in (None, 13)] == [(8, 512, 15), (8, 512, 13)]


def test_fine_pixels_take_a_finer_grid_with_an_entry_for_every_cell_that_shows_surface() -> None:
    images = scenes.images(count=4, height=300, width=400)
    log2 = math.ceil(math.log2(occupied(images, 4.0 / 1024)))
    assert log2 > 15
    assert chosen(images) == (9, 1024, log2)
    assert chosen(images, 12) == (9, 1024, 12)
