"""A map fused from images of a ball and a box whose distance is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from regnf_core.errors import DatasetError, InvalidOptionsError
from regnf_core.fields.build import open_field
from regnf_core.fields.color import has_color
from regnf_core.fields.observation import observation_of
from regnf_core.schema.observation_grid import FREE, SURFACE
from regnf_core.schema.safe_format import read_description
from regnf_fit.images.fusion import FusionOptions, fuse_images
from tests.fit.images import scenes

IMAGES = scenes.images(count=12, height=72, width=96)


def near_surface() -> tuple[torch.Tensor, np.ndarray]:
    """Points (N, 3) within 2 cm of the true surface, and their distances."""
    points = np.random.default_rng(5).uniform(*scenes.BOUNDS, size=(200_000, 3))
    exact = scenes.distance(points)
    return torch.from_numpy(points[np.abs(exact) < 0.02]).float(), exact[np.abs(exact) < 0.02]


def test_a_map_has_the_distances_colors_and_frame_of_its_images(tmp_path: Path) -> None:
    path, done = tmp_path / "map.safetensors", []
    report = fuse_images(IMAGES, path, progress=done.append, label="two", source={"dataset": "images"})
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
    assert [one.name for one in tmp_path.iterdir()] == ["map.safetensors"]


def test_a_map_keeps_what_its_images_have_seen(tmp_path: Path) -> None:
    path = tmp_path / "map.safetensors"
    fuse_images(IMAGES, path)
    seen = observation_of(open_field(path))
    assert seen is not None
    points = torch.from_numpy(np.random.default_rng(6).uniform(*scenes.BOUNDS, size=(20_000, 3))).float()
    exact = scenes.distance(points.numpy())
    states = seen.at(points).numpy()
    assert (states[exact < -0.05] != FREE).all()
    assert (states[exact > 0.1] == FREE).mean() > 0.9
    assert (states[np.abs(exact) < 0.003] == SURFACE).mean() > 0.8


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


def test_maps_are_not_bound_to_a_hash_grids_cube(tmp_path: Path) -> None:
    shift, poses = np.array([7.0, 0.0, 0.0]), IMAGES.T_world_camera.copy()
    poses[:, :3, 3] += shift
    fuse_images(replace(IMAGES, T_world_camera=poses, bounds=IMAGES.bounds + shift), tmp_path / "map.safetensors")
    top = torch.from_numpy(scenes.BALL_CENTER + shift + [0.0, 0.0, scenes.BALL_RADIUS])[None].float()
    assert abs(float(open_field(tmp_path / "map.safetensors").signed_distance(top))) < 0.005


def test_the_same_images_make_the_same_bytes(tmp_path: Path) -> None:
    for name in ("one", "two", "three"):
        fuse_images(IMAGES, tmp_path / f"{name}.safetensors")
    assert len({one.read_bytes() for one in tmp_path.iterdir()}) == 1
