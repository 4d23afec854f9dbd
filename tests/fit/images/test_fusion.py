"""A map fused from images of a ball and a box whose distance is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from regnf_core.errors import DatasetError, InvalidOptionsError
from regnf_core.fields.build import open_field
from regnf_core.fields.observation import has_color, observation_of
from regnf_core.importing.fusing import BlockGrid
from regnf_core.schema.description import FREE, SURFACE
from regnf_core.schema.safe_format import read_description
from regnf_data.fusing import fuse_blocks
from regnf_data.posed_images import PosedImages
from regnf_fit.images.fusion import FusionOptions, FusionReport, fuse_images, measured_rays
from regnf_fit.images.observing import attach_observation
from regnf_fit.images.preparation import prepare
from tests.fit.images import scenes

IMAGES = scenes.images(count=12, height=72, width=96)


def near_surface() -> tuple[torch.Tensor, np.ndarray]:
    """Points (N, 3) within 2 cm of the true surface, and their distances."""
    points = np.random.default_rng(5).uniform(*scenes.BOUNDS, size=(200_000, 3))
    exact = scenes.distance(points)
    return torch.from_numpy(points[np.abs(exact) < 0.02]).float(), exact[np.abs(exact) < 0.02]


@pytest.fixture(scope="module")
def fused(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, FusionReport, list[int]]:
    path, done = tmp_path_factory.mktemp("fused") / "map.safetensors", []
    report = fuse_images(IMAGES, path, progress=done.append, label="two", source={"dataset": "images"})
    return path, report, done


def test_a_map_has_the_distances_colors_and_frame_of_its_images(fused: tuple[Path, FusionReport, list[int]]) -> None:
    path, report, done = fused
    field = open_field(path)
    points, exact = near_surface()
    error = np.abs(field.signed_distance(points).numpy() - exact)
    # the pixels are 18 mm wide at the surface
    assert np.median(error) < 0.002
    assert np.quantile(error, 0.9) < 0.01
    assert report.depth_error_median < 0.15 * report.voxel
    assert report.voxel == pytest.approx(1.3 / (0.9 * 96), rel=0.1)
    assert report.truncation == pytest.approx(4.0 * report.voxel)
    assert done == list(range(12))
    assert has_color(field)
    description = read_description(path)
    assert (description["label"], description["source"]) == ("two", {"dataset": "images"})
    assert [one.name for one in path.parent.iterdir()] == ["map.safetensors"]
    seen = observation_of(field)
    assert seen is not None
    places = torch.from_numpy(np.random.default_rng(6).uniform(*scenes.BOUNDS, size=(20_000, 3))).float()
    exact, states = scenes.distance(places.numpy()), seen.at(places).numpy()
    assert (states[exact < -0.05] != FREE).all()
    assert (states[exact > 0.1] == FREE).mean() > 0.9
    assert (states[np.abs(exact) < 0.003] == SURFACE).mean() > 0.8


def misplaced(images: PosedImages, deviation: float) -> PosedImages:
    """Each image's depths are wrong by a number of their own, as where poses drift."""
    assert images.depths is not None
    wrong = np.random.default_rng(7).normal(scale=deviation, size=(len(images), 1, 1)).astype(np.float32)
    return replace(images, depths=np.where(images.depths > 0.0, images.depths + wrong, np.float32(0.0)))


def test_the_truncation_follows_what_images_differ_by(tmp_path: Path) -> None:
    images = misplaced(scenes.images(count=48, height=72, width=96, ball_alone=True), 0.04)
    report = fuse_images(images, tmp_path / "map.safetensors")
    prepared = prepare(images, "auto", np.random.default_rng(0))
    deviation = np.median(prepared.spread.at(measured_rays(prepared).depths.numpy()))
    assert report.truncation == pytest.approx(6.0 * deviation, rel=1e-3)
    assert report.truncation > 4.5 * report.voxel
    directions = np.random.default_rng(8).normal(size=(2000, 3))
    surface = scenes.BALL_CENTER + scenes.BALL_RADIUS * directions / np.linalg.norm(directions, axis=1)[:, None]
    distances = open_field(tmp_path / "map.safetensors").signed_distance(torch.from_numpy(surface).float())
    # 48 images, each off by .04: their mean is off by .006
    assert abs(float(distances.median())) < 0.01


def test_a_small_thing_before_a_coarse_sensor_is_fused(tmp_path: Path) -> None:
    """Its depths end many voxels beside its surface, which is there all the same."""
    noisy = misplaced(scenes.images(count=16, height=144, width=192, ball_alone=True, away=4.0), 0.08)
    corners = scenes.BALL_CENTER + 1.6 * scenes.BALL_RADIUS * np.array([[-1.0], [1.0]])
    fuse_images(replace(noisy, bounds=corners), tmp_path / "map.safetensors")
    field = open_field(tmp_path / "map.safetensors")
    seen = observation_of(field)
    assert seen is not None
    assert seen.voxel < 0.02
    along = scenes.BALL_RADIUS * np.outer([0.0, 1.4], [1.0, 0.0, 0.0])
    inside, outside = field.signed_distance(torch.from_numpy(scenes.BALL_CENTER + along).float())
    assert inside < -0.1 < 0.04 < outside
    shift, poses = 3.0 * scenes.BALL_RADIUS * np.array([1.0, 0.0, 0.0]), noisy.T_world_camera.copy()
    poses[:, :3, 3] += shift
    elsewhere = replace(noisy, T_world_camera=poses, bounds=corners + shift)
    with pytest.raises(DatasetError) as refused:
        attach_observation(tmp_path / "map.safetensors", elsewhere)
    assert refused.value.reason == "DATASET_OF_ANOTHER_FRAME"


@pytest.mark.long
def test_voxels_are_no_smaller_than_half_the_deviation(tmp_path: Path) -> None:
    sharp = scenes.images(count=12, height=288, width=384)
    exact = fuse_images(sharp, tmp_path / "exact.safetensors")
    rough = fuse_images(misplaced(sharp, 0.03), tmp_path / "rough.safetensors")
    assert exact.truncation == pytest.approx(4.0 * exact.voxel)
    assert rough.voxel > 1.3 * exact.voxel
    assert rough.truncation == pytest.approx(12.0 * rough.voxel)


def test_what_lies_outside_the_bounds_or_the_masks_is_left_out(tmp_path: Path) -> None:
    ball = scenes.BALL_CENTER + scenes.BALL_RADIUS * np.array([[-1.0], [1.0]])
    fuse_images(replace(IMAGES, bounds=ball), tmp_path / "bounds.safetensors")
    assert IMAGES.depths is not None
    alone = scenes.images(count=12, height=72, width=96, ball_alone=True).depths
    masks = (IMAGES.depths > 0.0) & (IMAGES.depths == alone)
    fuse_images(replace(IMAGES, masks=masks), tmp_path / "masks.safetensors")
    box = torch.from_numpy(scenes.BOX_CENTER - [scenes.BOX_HALF[0], 0.0, 0.0])[None].float()
    for name in ("bounds", "masks"):
        assert float(open_field(tmp_path / f"{name}.safetensors").signed_distance(box)) > 0.05


def test_what_cannot_be_fused_is_refused_and_nothing_is_left(tmp_path: Path) -> None:
    with pytest.raises(DatasetError) as caught:
        fuse_images(replace(IMAGES, depths=None), tmp_path / "map.safetensors")
    assert caught.value.reason == "DATASET_DEPTH_MISSING"
    with pytest.raises(InvalidOptionsError, match="too small"):
        fuse_images(IMAGES, tmp_path / "map.safetensors", FusionOptions(voxel=1e-9))
    with pytest.raises(DatasetError) as caught:
        fuse_images(replace(IMAGES, bounds=IMAGES.bounds + np.array([0.0, 0.0, 1.5])), tmp_path / "map.safetensors")
    assert caught.value.reason == "DATASET_NOTHING_IN_BOUNDS"
    assert list(tmp_path.iterdir()) == []


def test_the_same_images_make_the_same_bytes(fused: tuple[Path, FusionReport, list[int]], tmp_path: Path) -> None:
    fuse_images(IMAGES, tmp_path / "again.safetensors", label="two", source={"dataset": "images"})
    assert (tmp_path / "again.safetensors").read_bytes() == fused[0].read_bytes()


def test_an_image_with_hardly_a_depth_is_no_error(tmp_path: Path) -> None:
    """Open3D looks at every fourth pixel and refuses an image where none of them has a depth."""
    assert IMAGES.depths is not None
    depths = IMAGES.depths.copy()
    alone = np.zeros_like(depths[3])
    alone[37, 49] = depths[3][37, 49]
    assert alone.any()
    depths[3] = alone
    fuse_images(replace(IMAGES, depths=depths), tmp_path / "map.safetensors")
    points, exact = near_surface()
    error = np.abs(open_field(tmp_path / "map.safetensors").signed_distance(points).numpy() - exact)
    assert np.median(error) < 0.003


def test_images_without_surface_within_reach_have_a_reason(tmp_path: Path) -> None:
    assert IMAGES.depths is not None
    with pytest.raises(DatasetError) as raised:
        fuse_blocks(
            IMAGES.depths,
            IMAGES.intrinsics,
            IMAGES.T_world_camera,
            BlockGrid(0.02, 4.0, 1e-3),
            tmp_path / "map.safetensors",
        )
    assert raised.value.reason == "DATASET_NOTHING_IN_BOUNDS"
    assert not list(tmp_path.iterdir())


def test_a_map_in_geodetic_coordinates_is_as_good_as_one_at_the_origin(
    fused: tuple[Path, FusionReport, list[int]], tmp_path: Path
) -> None:
    """Half a million meters from the origin, numbers of single precision are 3 cm apart."""
    origin = np.array([448_262.3, 5_413_920.7, 112.4])
    report = fuse_images(IMAGES.moved(-origin, 1.0), tmp_path / "far.safetensors")
    assert report.depth_error_median == pytest.approx(fused[1].depth_error_median, rel=0.2)
    description = read_description(tmp_path / "far.safetensors")
    np.testing.assert_allclose(description["bounds"], scenes.BOUNDS + origin, atol=0.1)
    assert np.array(description["placement"]["transform"])[:3, 3].tolist() == [448262.0, 5413921.0, 112.0]
    top = torch.from_numpy(scenes.BALL_CENTER + origin + [0.0, 0.0, scenes.BALL_RADIUS])[None]
    assert abs(float(open_field(tmp_path / "far.safetensors").signed_distance(top))) < 0.005
