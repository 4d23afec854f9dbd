"""What images have seen of a volume, against the true distance and a slow ray by ray march."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from regnf_core.errors import InvalidOptionsError
from regnf_core.fields.build import open_field
from regnf_core.fields.observation import observation_of
from regnf_core.schema.description import FREE, SURFACE, UNSEEN
from regnf_data.posed_images import PosedImages
from regnf_fit.images.fit import FitFiles, reconstruct
from regnf_fit.images.observing import DepthSpread, depth_spread, local_planes, observe
from regnf_fit.options import ReconstructionOptions
from tests.fit.images import scenes
from tests.fit.images.scenes import BOUNDS, distance, images

VOXELS = 48


SIZE = {"height": 72, "width": 96}
"""Pixels narrower than the voxels are wide."""


def centers(shape: tuple[int, ...], voxel: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return (np.stack(np.indices(shape), axis=-1) + 0.5) * voxel + BOUNDS[0]


def test_states_agree_with_the_true_distance() -> None:
    seen = observe(images(count=16, **SIZE), VOXELS)
    assert seen is not None
    states, voxel = seen.states.numpy(), seen.voxel
    assert voxel == 1.2 / VOXELS
    assert states.shape == (48, 32, 32)
    true = distance(centers(states.shape, voxel).reshape(-1, 3)).reshape(states.shape)
    half_diagonal = 0.5 * 3.0**0.5 * voxel
    assert (true[states == FREE] > -voxel).all()
    # A few rays graze an edge, where tracing stops short.
    assert (np.abs(true[states == SURFACE]) <= half_diagonal + 1e-6).mean() > 0.998
    assert (states[true < -2.0 * voxel] == UNSEEN).all()
    # Seen from all round: hardly any of the outside is left, and most of the surface was met.
    assert (states[true > 2.0 * voxel] == FREE).mean() > 0.9
    assert (states[np.abs(true) < 0.2 * voxel] == SURFACE).mean() > 0.8


def test_one_view_leaves_its_shadow_unseen() -> None:
    whole = images(**SIZE)
    one = replace(
        whole,
        colors=whole.colors[:1],
        intrinsics=whole.intrinsics[:1],
        T_world_camera=whole.T_world_camera[:1],
        depths=None if whole.depths is None else whole.depths[:1],
    )
    assert one.depths is not None
    seen = observe(one, VOXELS)
    assert seen is not None
    # March along every fourth pixel's ray: free up to a voxel before its end, unseen from a voxel behind it on.
    rows, columns = np.nonzero(one.depths[0] > 0.0)
    rows, columns = rows[::4], columns[::4]
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], -1) @ np.linalg.inv(one.intrinsics[0]).T
    pose = one.T_world_camera[0]
    ends = one.depths[0][rows, columns].astype(np.float64)
    diagonal = 3.0**0.5 * seen.voxel
    for step in (-6.0, -3.0, 3.0, 6.0):
        z = ends + step * diagonal
        points = torch.from_numpy((z[:, None] * pixels) @ pose[:3, :3].T + pose[:3, 3])
        inside = ((points > torch.from_numpy(BOUNDS[0])) & (points < torch.from_numpy(BOUNDS[1]))).all(-1)
        states = seen.at(points[inside])
        wanted = FREE if step < 0 else UNSEEN
        assert len(states) > 20
        assert float((states == wanted).float().mean()) > 0.85, step


def test_background_is_looked_through_and_colors_alone_tell_nothing() -> None:
    some = images(count=1)
    assert some.depths is not None
    nothing_there = replace(some, depths=np.zeros_like(some.depths), masks=np.zeros(some.depths.shape, bool))
    seen = observe(nothing_there, VOXELS)
    assert seen is not None
    assert (seen.states == FREE).float().mean() > 0.5
    assert not (seen.states == SURFACE).any()
    assert observe(replace(some, depths=None), VOXELS) is None
    assert observe(some, 0) is None


def test_a_fit_writes_what_was_seen(tmp_path: Path) -> None:
    options = ReconstructionOptions(iterations=2, observation_voxels=24)
    reconstruct(images(), FitFiles(tmp_path / "field.safetensors"), options, device="cpu")
    written, made = observation_of(open_field(tmp_path / "field.safetensors")), observe(images(), 24)
    assert written is not None
    assert made is not None
    torch.testing.assert_close(written.states, made.states)
    reconstruct(images(), FitFiles(tmp_path / "plain.safetensors"), replace(options, observation_voxels=0))
    assert observation_of(open_field(tmp_path / "plain.safetensors")) is None


def test_voxels_are_no_narrower_than_pixels() -> None:
    some = images()
    assert some.depths is not None
    # On the median surface a pixel is depth / focal length wide.
    pixel = float(np.median(some.depths[some.depths > 0.0])) / some.intrinsics[0, 0, 0]
    seen = observe(some, 400)
    assert seen is not None
    assert 400 * pixel > 1.2
    assert abs(seen.voxel / pixel - 1.2) < 1e-6


def test_what_is_nearer_to_a_surface_than_the_noise_is_not_seen_to_be_free() -> None:
    some, deviation = images(count=16, **SIZE), 0.03
    sure, unsure = observe(some, VOXELS), observe(some, VOXELS, DepthSpread(np.array([1.0]), np.array([deviation])))
    assert sure is not None
    assert unsure is not None
    assert torch.equal(sure.states == SURFACE, unsure.states == SURFACE)
    assert not bool(((sure.states != FREE) & (unsure.states == FREE)).any())
    lost = ((sure.states == FREE) & (unsure.states == UNSEEN)).numpy()
    assert lost.any()
    # a ray of these images is at most 1.25 times as long as its depth
    assert distance(centers(lost.shape, sure.voxel)[lost]).max() < 1.25 * 3.0 * deviation + sure.voxel


def test_a_voxel_at_the_edge_of_a_thing_is_not_free() -> None:
    # The image's left half shows a plate at depth 1, its right half a wall at 2, but for some pixels without depth.
    depth = np.full((16, 16), 2.0, np.float32)
    depth[:, :8] = 1.0
    depth[:, 11:] = 0.0
    camera = np.array([[8.0, 0.0, 8.0], [0.0, 8.0, 8.0], [0.0, 0.0, 1.0]])
    bounds = np.array([[-0.5125, -0.5625, 1.3875], [0.6125, 0.5625, 1.6125]])
    one = PosedImages(
        colors=np.zeros((1, 16, 16, 3), np.uint8),
        intrinsics=camera[None],
        T_world_camera=np.eye(4)[None],
        bounds=bounds,
        depths=depth[None],
    )
    seen = observe(one, 5)
    assert seen is not None
    assert seen.states.shape == (5, 5, 1)
    # Centers at x = -.4, -.175, .05, .275, .5 and depth 1.5: columns 5.9, 7.1, 8.3, 9.5, 10.7 of the image.
    assert seen.states[:, 2, 0].tolist() == [UNSEEN, UNSEEN, UNSEEN, FREE, UNSEEN]


@pytest.mark.parametrize("voxels", [-1, 513])
def test_more_voxels_than_a_field_keeps_are_refused_before_the_fit(voxels: int, tmp_path: Path) -> None:
    with pytest.raises(InvalidOptionsError, match="observation_voxels"):
        reconstruct(images(count=4), FitFiles(tmp_path / "ball"), ReconstructionOptions(observation_voxels=voxels))
    assert not list(tmp_path.iterdir())


# Planes through depths, their noise, and how one image's depths differ from another's.


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


def test_cameras_that_see_different_things_tell_nothing(wall):
    poses = wall.T_world_camera.copy()
    poses[:, 0, 3] = 100.0 * np.arange(COUNT)
    assert len(measured(replace(wall, T_world_camera=poses)).depths) == 0
