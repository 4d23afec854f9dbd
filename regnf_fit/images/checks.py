"""What images must be to be worth fitting to."""

from __future__ import annotations

import numpy as np

from regnf_core.errors import DatasetError
from regnf_data.posed_images import PosedImages

GRID_RADIUS = 2.0
_MIN_PIXELS = 100
_MIN_DEPTH_SHARE = 1e-4
_MIN_SPREAD = 2.0
"""Standard deviation of the colors, of 255."""


def check_images(images: PosedImages) -> None:
    """Raise DatasetError where a fit would have nothing to go by.

    Reasons: DATASET_NO_FRAMES, DATASET_POSE_NOT_RIGID, DATASET_INTRINSICS_INVALID, DATASET_BOUNDS_EMPTY,
    DATASET_DEPTH_MISSING, DATASET_NO_COLOR_VARIETY.
    """
    if len(images) == 0 or images.colors[0].size == 0:
        raise DatasetError("the dataset holds no pixels", reason="DATASET_NO_FRAMES")
    _check_cameras(images)
    _check_bounds(images.bounds)
    if images.depths is not None:
        if not np.isfinite(images.depths).all() or (images.depths > 0).mean() < _MIN_DEPTH_SHARE:
            raise DatasetError("no image has depths worth the name", reason="DATASET_DEPTH_MISSING")
    elif float(images.colors.reshape(-1, 3).std(axis=0).max()) < _MIN_SPREAD:
        raise DatasetError("the images have no depths and are all of one color", reason="DATASET_NO_COLOR_VARIETY")


def check_seen(pixels: int) -> None:
    """Raise DatasetError (DATASET_NOTHING_IN_BOUNDS) when too few pixels show anything within the bounds."""
    if pixels < _MIN_PIXELS:
        raise DatasetError(f"only {pixels} pixels show anything within the bounds", reason="DATASET_NOTHING_IN_BOUNDS")


def _check_cameras(images: PosedImages) -> None:
    rotation = images.T_world_camera[:, :3, :3]
    product = rotation @ rotation.transpose(0, 2, 1)
    # not (a <= b): NaN must fail too
    if not (np.isfinite(images.T_world_camera).all() and (np.abs(product - np.eye(3)) <= 1e-3).all()):
        raise DatasetError("a camera's pose is not finite, or no rotation", reason="DATASET_POSE_NOT_RIGID")
    focal = images.intrinsics[:, [0, 1], [0, 1]]
    if not (np.isfinite(images.intrinsics).all() and (focal > 0.0).all()):
        raise DatasetError("a camera's focal length is not positive", reason="DATASET_INTRINSICS_INVALID")


def _check_bounds(bounds: np.typing.NDArray[np.float64]) -> None:
    if not (np.isfinite(bounds).all() and (bounds[0] < bounds[1]).all()):
        raise DatasetError("the dataset's bounds are empty", reason="DATASET_BOUNDS_EMPTY")


def check_within_grid(bounds: np.typing.NDArray[np.float64]) -> None:
    """Raise DatasetError (DATASET_OUTSIDE_GRID) for bounds (2, 3) beyond the hash grid of a fit."""
    if np.abs(bounds).max() > GRID_RADIUS:
        raise DatasetError(
            "the dataset's bounds reach beyond [-2, 2]: scale its poses and depths down", reason="DATASET_OUTSIDE_GRID"
        )
