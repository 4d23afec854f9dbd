"""What is refused before a fit or a fusion, and what the refusal says."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from regnf_core.errors import DatasetError
from regnf_data.posed_images import PosedImages
from regnf_fit.images.fit import FitFiles, reconstruct
from regnf_fit.images.fusion import fuse_images
from tests.fit.images import scenes

FITS: tuple[Callable[[PosedImages, Path], object], ...] = (
    fuse_images,
    lambda images, path: reconstruct(images, FitFiles(path)),
)


def within(images: PosedImages | None = None) -> PosedImages:
    """The images with bounds that the cameras stand in, and without masks: many pixels show nothing."""
    return replace(images or scenes.images(), bounds=np.array([[-3.0] * 3, [3.0] * 3]), masks=None)


def scaled(factor: float, poses: float = 1.0) -> PosedImages:
    """Depths and poses of another unit than the bounds."""
    images = within()
    assert images.depths is not None
    T = images.T_world_camera.copy()
    T[:, :3, 3] *= poses
    return replace(images, depths=(factor * images.depths).astype(np.float32), T_world_camera=T)


@pytest.mark.parametrize("fit", FITS)
@pytest.mark.parametrize(
    ("images", "said"),
    [
        (scaled(1000.0), "depths in millimeters? Divided by 1000, 100 %"),
        (scaled(1000.0, 1000.0), "depths and poses in millimeters? Divided by 1000"),
        (scaled(1.0, 1000.0), "poses in millimeters? Divided by 1000"),
        (scaled(100.0), "depths in centimeters? Divided by 100"),
        (scaled(5000.0), "depths in steps of 1/5000? Divided by 5000"),
    ],
)
def test_another_unit_is_named(fit: Callable[..., object], images: PosedImages, said: str, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="median") as caught:
        fit(images, tmp_path / "map.safetensors")
    assert caught.value.reason == "DATASET_NOTHING_IN_BOUNDS"
    assert said in str(caught.value.hint)
    assert "bounds, (-3, -3, -3) to (3, 3, 3);" in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_bounds_that_were_not_given_are_said(tmp_path: Path) -> None:
    images = scenes.images()
    far = images.T_world_camera.copy()
    far[:, :3, 3] += (5.0, 0.0, 0.0)
    cube = np.array([[-1.0] * 3, [1.0] * 3])
    with pytest.raises(DatasetError, match=r"where meta_data.json has no scene_box.*end within \(4") as caught:
        fuse_images(replace(images, T_world_camera=far, bounds=cube), tmp_path / "map.safetensors")
    assert '"scene_box": {"aabb": [[4' in str(caught.value.hint)


def test_masks_that_leave_nothing(tmp_path: Path) -> None:
    images = scenes.images()
    with pytest.raises(DatasetError, match="only 0 pixels") as caught:
        fuse_images(replace(images, masks=np.zeros(images.colors.shape[:3], bool)), tmp_path / "map.safetensors")
    assert "the other way round" in str(caught.value.hint)


def test_an_empty_image_among_good_ones_is_passed_over(tmp_path: Path) -> None:
    images = within()
    assert images.depths is not None
    depths = images.depths.copy()
    depths[3] = 0.0
    assert fuse_images(replace(images, depths=depths), tmp_path / "map.safetensors").depth_error_median < 0.01
