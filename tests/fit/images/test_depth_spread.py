"""Planes through depths, their noise, and how one image's depths differ from another's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from regnf_fit.images.observing import depth_spread, local_planes
from tests.fit.images import scenes


def test_cosines_on_a_slanted_plane():
    camera = np.array([[50.0, 0.0, 20.0], [0.0, 50.0, 15.0], [0.0, 0.0, 1.0]])
    rows, columns = np.indices((30, 40)) + 0.5
    rays = np.stack([(columns - 20.0) / 50.0, (rows - 15.0) / 50.0, np.ones_like(rows)], axis=-1)
    normal = np.array([0.6, 0.0, 0.8])
    depth = 2.0 / (rays @ normal)
    expected = (rays @ normal) / np.linalg.norm(rays, axis=-1)
    found = local_planes(depth[None].astype(np.float32), camera[None]).cosines[0]
    inner = found[2:-2, 2:-2]
    assert (inner > 0.0).all()
    np.testing.assert_allclose(inner, expected[2:-2, 2:-2], atol=2e-3)


def test_no_cosine_without_depth():
    depth = np.zeros((1, 8, 8), np.float32)
    depth[0, 4, 4] = 1.0
    assert (local_planes(depth, np.eye(3)[None]).cosines == 0.0).all()


def test_the_noise_is_found_and_grows_with_the_depth():
    camera = np.array([[50.0, 0.0, 20.0], [0.0, 50.0, 15.0], [0.0, 0.0, 1.0]])
    rng = np.random.default_rng(0)
    exact = np.repeat(np.linspace(1.0, 3.0, 9), 2)[:, None, None] * np.ones((18, 30, 40))
    expected = 0.002 * exact**2
    noisy = (exact + expected * rng.normal(size=exact.shape)).astype(np.float32)
    found = local_planes(noisy, np.tile(camera, (18, 1, 1))).deviations
    np.testing.assert_allclose(np.median(found, axis=(1, 2))[1:-1], expected[1:-1, 0, 0], rtol=0.1)


def test_a_thin_post_keeps_its_own_plane():
    camera = np.array([[50.0, 0.0, 20.0], [0.0, 50.0, 15.0], [0.0, 0.0, 1.0]])
    depth = np.full((1, 30, 40), 3.0, np.float32)
    depth[0, :, 20:22] = 2.0
    cosines = local_planes(depth, camera[None]).cosines[0]
    rows, columns = np.indices((30, 40)) + 0.5
    facing = 1.0 / np.sqrt(1.0 + ((columns - 20.0) / 50.0) ** 2 + ((rows - 15.0) / 50.0) ** 2)
    np.testing.assert_allclose(cosines[1:-1, 20:22], facing[1:-1, 20:22], atol=1e-3)
    np.testing.assert_allclose(cosines[2:-2, 17:19], facing[2:-2, 17:19], atol=1e-3)


COUNT = 60


def measured(images):
    return depth_spread(images, local_planes(images.depths, images.intrinsics).cosines)


def along_camera(images, errors):
    """The images with depths that err, by (N, H, W) or (N, 1, 1), where there are any."""
    return replace(images, depths=np.where(images.depths > 0.0, images.depths + errors, 0.0).astype(np.float32))


@pytest.fixture(scope="module")
def wall():
    """Cameras before a wall, which is at depth 2 of all of them."""
    images = scenes.images(count=COUNT)
    poses = np.tile(np.eye(4), (COUNT, 1, 1))
    poses[:, :2, 3] = np.random.default_rng(1).uniform(-0.3, 0.3, (COUNT, 2))
    depths = np.full(images.depths.shape, 2.0, np.float32)
    return replace(images, T_world_camera=poses, depths=depths, masks=None)


def test_noise_of_pixels_is_found(wall):
    rng = np.random.default_rng(2)
    found = measured(along_camera(wall, 0.01 * rng.normal(size=wall.depths.shape)))
    np.testing.assert_allclose(found.at(np.array([2.0], np.float32)), 0.01, rtol=0.1)


def test_errors_that_an_image_shares_are_found_too(wall):
    rng = np.random.default_rng(3)
    shared = 0.012 * rng.normal(size=(COUNT, 1, 1))
    images = along_camera(wall, shared + 0.004 * rng.normal(size=wall.depths.shape))
    expected = np.hypot(shared.std(ddof=1), 0.004)
    np.testing.assert_allclose(measured(images).at(np.array([2.0], np.float32)), expected, rtol=0.25)
    within = local_planes(images.depths, images.intrinsics).deviations
    assert np.median(within) < 0.4 * expected  # neighboring pixels do not show them


def test_exact_depths_have_only_the_pixels_width():
    images = scenes.images(count=20)
    found = measured(images)
    widths = found.depths / images.intrinsics[0, 0, 0]
    assert (found.deviations < widths / np.sqrt(12.0)).all()  # a place in a pixel is known to no more than that


def test_noise_that_grows_with_the_depth(wall):
    rng = np.random.default_rng(4)
    images = replace(wall, depths=wall.depths.copy(), T_world_camera=wall.T_world_camera.copy())
    # the cameras step back, and the wall stays where it is
    for number, back in enumerate(np.linspace(0.0, 2.0, COUNT)):
        images.T_world_camera[number, 2, 3] = -back
        images.depths[number] += back
    found = measured(along_camera(images, 0.002 * images.depths**2 * rng.normal(size=images.depths.shape)))
    assert found.at(np.array([3.8], np.float32))[0] > 1.5 * found.at(np.array([2.2], np.float32))[0]


@pytest.mark.parametrize("count", [1, 0])
def test_without_overlap_nothing_is_known(wall, count):
    images = replace(
        wall,
        colors=wall.colors[:count],
        depths=wall.depths[:count],
        intrinsics=wall.intrinsics[:count],
        T_world_camera=wall.T_world_camera[:count],
    )
    found = depth_spread(images, np.ones(images.depths.shape, np.float32))
    assert (found.at(np.array([1.0, 2.0], np.float32)) == 0.0).all()
