"""Projective distances are cut to the distance to the surface; true distances are left alone."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from regnf_core.importing.containers.euclidean import bound_by_surface, crossings

EDGE = 8
VOXEL = 0.02
Floats = NDArray[np.float64]


def blocks_about(reach: int) -> NDArray[np.int64]:
    """All blocks (B, 3) of a cube about the origin."""
    axis = np.arange(-reach, reach)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)


def nodes_of(blocks: NDArray[np.int64]) -> Floats:
    """(B, EDGE, EDGE, EDGE, 3): where the nodes are."""
    local = np.stack(np.meshgrid(*[np.arange(EDGE)] * 3, indexing="ij"), axis=-1)
    return VOXEL * (EDGE * blocks[:, None, None, None] + local)


def ball(nodes: Floats, radius: float = 0.2) -> Floats:
    return np.asarray(np.linalg.norm(nodes - 0.003, axis=-1) - radius)


def everywhere(values: NDArray[np.float32]) -> NDArray[np.bool_]:
    return np.ones(values.shape, bool)


def test_a_plane_seen_at_an_angle_gets_its_distances() -> None:
    """Along a camera's axis 60 degrees from the normal, the values are twice the distance."""
    blocks = blocks_about(2)
    normal = np.array([0.36, 0.48, 0.8])
    true = nodes_of(blocks) @ normal - 0.011
    values = np.clip(2.0 * true, -0.1, 0.1).astype(np.float32)
    before = crossings(values, everywhere(values), blocks)
    assert bound_by_surface(values, everywhere(values), blocks, VOXEL)
    inside = (np.abs(nodes_of(blocks)) < 0.2).all(axis=-1)  # the crossings end at the blocks' border
    np.testing.assert_allclose(values[inside], np.clip(true, -0.1, 0.1)[inside], atol=1e-6)
    after = crossings(values, everywhere(values), blocks)
    np.testing.assert_allclose(after, before, rtol=0, atol=0.05)


@pytest.mark.parametrize("factor", [1.5, 2.5])
def test_a_ball_gets_its_distances(factor: float) -> None:
    blocks = blocks_about(2)
    true = ball(nodes_of(blocks))
    values = np.clip(factor * true, -0.1, 0.1).astype(np.float32)
    assert bound_by_surface(values, everywhere(values), blocks, VOXEL)
    np.testing.assert_allclose(values, np.clip(true, -0.1, 0.1), atol=0.1 * VOXEL)


def test_true_distances_stay_to_the_last_digit() -> None:
    blocks = blocks_about(2)
    values = np.clip(ball(nodes_of(blocks)), -0.1, 0.1).astype(np.float32)
    before = values.copy()
    assert not bound_by_surface(values, everywhere(values), blocks, VOXEL)
    np.testing.assert_array_equal(values, before)


def test_smaller_values_stay() -> None:
    """A distance to a surface that the grid is too coarse to show, or of another map's scale, is not made larger."""
    blocks = blocks_about(2)
    true = ball(nodes_of(blocks))
    values = np.clip(np.where(true > 0.0, 0.5 * true, 2.0 * true), -0.1, 0.1).astype(np.float32)
    before = values.copy()
    assert bound_by_surface(values, everywhere(values), blocks, VOXEL)
    deep = true > VOXEL
    np.testing.assert_array_equal(values[deep], before[deep])


def test_without_a_surface_nothing_changes() -> None:
    values = np.full((1, EDGE, EDGE, EDGE), 0.1, np.float32)
    assert not bound_by_surface(values, everywhere(values), np.zeros((1, 3), np.int64), VOXEL)
    assert (values == np.float32(0.1)).all()


def test_unseen_nodes_neither_change_nor_show_a_surface() -> None:
    blocks = blocks_about(2)
    nodes = nodes_of(blocks)
    values = np.clip(2.0 * ball(nodes), -0.1, 0.1).astype(np.float32)
    seen = nodes[..., 0] < 0.1
    values[~seen] = 7.0
    assert bound_by_surface(values, seen, blocks, VOXEL)
    assert (values[~seen] == 7.0).all()
    assert (VOXEL * crossings(values, seen, blocks)[:, 0]).max() < 0.1


def test_crossings_are_found_between_blocks_in_any_order() -> None:
    """Two blocks, one above the other along each axis in turn: the surface lies just between them."""
    for axis in range(3):
        step = np.eye(3, dtype=np.int64)[axis]
        for blocks in (np.stack([0 * step, step]), np.stack([step, 0 * step])):
            upper = blocks[:, axis] == 1
            values = np.where(upper[:, None, None, None], 0.25, -0.75) * np.ones((2, EDGE, EDGE, EDGE))
            found = crossings(values.astype(np.float32), np.ones(values.shape, bool), blocks)
            assert len(found) == EDGE**2
            np.testing.assert_allclose(found[:, axis], EDGE - 1 + 0.75)


def test_axes_of_other_spacings() -> None:
    """One grid of nodes that are not cubes; a wall across the long axis, twice as far as it is."""
    spacing = np.array([0.01, 0.02, 0.04])
    nodes = np.stack(np.meshgrid(np.arange(30), np.arange(15), np.arange(8), indexing="ij"), axis=-1) * spacing
    true = nodes[..., 0] - 0.144
    values = np.clip(2.0 * true, -0.06, 0.06).astype(np.float32)[None]
    assert bound_by_surface(values, everywhere(values), np.zeros((1, 3), np.int64), spacing)
    np.testing.assert_allclose(values[0], np.clip(true, -0.06, 0.06), atol=1e-6)
