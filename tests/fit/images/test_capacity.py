"""The grid that images ask for: by hand from their pixels and points."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from regnf_core.schema.hash_grid_config import HashGridConfig
from regnf_data.posed_images import PosedImages
from regnf_fit.images.fit import suited
from regnf_fit.images.preparation import prepare
from regnf_fit.options import ReconstructionOptions
from tests.fit.images import scenes


def chosen(images: PosedImages, options: ReconstructionOptions) -> ReconstructionOptions:
    return suited(options, prepare(images, "auto", np.random.default_rng(0)))


def size(grid: HashGridConfig) -> tuple[int, int, int]:
    """Levels, nodes along an edge of the finest, log2 of the entries a level."""
    return grid.levels, round(grid.scales()[-1]) + 1, grid.log2_table_size


def occupied(images: PosedImages, edge: float) -> int:
    """Cells of this edge with a measured point in them, one pixel after another."""
    assert images.depths is not None
    cells = set()
    for depth, camera, pose in zip(images.depths, images.intrinsics, images.T_world_camera, strict=True):
        for row, column in zip(*np.nonzero(depth), strict=True):
            ray = np.linalg.inv(camera) @ (column + 0.5, row + 0.5, 1.0)
            cells.add(tuple(np.floor((pose[:3, :3] @ (depth[row, column] * ray) + pose[:3, 3]) / edge)))
    return len(cells)


def test_coarse_pixels_take_the_smallest_grid() -> None:
    options = chosen(scenes.images(), ReconstructionOptions())
    assert (size(options.grid), options.iterations) == ((8, 512, 15), 3000)


def test_fine_pixels_take_a_finer_grid_with_an_entry_for_every_cell_that_shows_surface() -> None:
    images = scenes.images(count=4, height=300, width=400)
    options = chosen(images, ReconstructionOptions())
    log2 = math.ceil(math.log2(occupied(images, 4.0 / 1024)))
    assert log2 > 15
    assert size(options.grid) == (9, 1024, log2)
    assert options.iterations == 3000


def test_what_is_given_is_kept() -> None:
    images = scenes.images(count=4, height=300, width=400)
    grid = HashGridConfig.from_top_resolution(64, levels=4, log2_table_size=10)
    options = chosen(images, ReconstructionOptions(grid=grid, iterations=7))
    assert (options.grid, options.iterations) == (grid, 7)
    assert size(chosen(images, ReconstructionOptions(table_log2=12)).grid) == (9, 1024, 12)


@pytest.mark.parametrize("table_log2", [None, 13])
def test_colors_alone_take_the_smallest_grid(table_log2: int | None) -> None:
    images = replace(scenes.images(count=2, height=300, width=400), depths=None)
    options = chosen(images, ReconstructionOptions(table_log2=table_log2))
    assert size(options.grid) == (8, 512, table_log2 or 15)
