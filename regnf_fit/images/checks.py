"""What images must be to be worth fitting to."""

from __future__ import annotations

import json

import numpy as np
from numpy.typing import NDArray

from regnf_core.errors import DatasetError
from regnf_data.agreement import score_of_scale
from regnf_data.posed_images import PosedImages
from regnf_data.sdfstudio import USUAL_BOUNDS

Floats = NDArray[np.float64]

_MIN_PIXELS = 100
_MIN_DEPTH_SHARE = 1e-4
_MIN_SPREAD = 2.0
"""Standard deviation of the colors, of 255."""
_SAMPLED = 20_000
_EXPLAINED = 0.5
"""Of the depths; a unit that puts fewer within the bounds explains nothing."""
UNITS = (
    (0.3048, "feet"), (0.2, "steps of 1/5000 that were read as 1/1000"), (5.0, "steps of 1/1000 read as 1/5000"),
    (0.0254, "inches"), (0.01, "centimeters"), (100.0, "units that were divided by 100 by mistake"),
    (0.001, "millimeters"), (1000.0, "units that were divided by 1000 by mistake"), (0.0002, "steps of 1/5000"),
)  # fmt: skip
"""Factors that bring lengths of another unit into the world's, nearest to 1 first, and what the unit then is."""


def check_images(images: PosedImages) -> None:
    """Raise DatasetError where a fit would have nothing to go by.

    Reasons: DATASET_NO_FRAMES, DATASET_POSE_NOT_RIGID, DATASET_INTRINSICS_INVALID, DATASET_BOUNDS_EMPTY,
    DATASET_DEPTH_MISSING, DATASET_NO_COLOR_VARIETY.
    """
    if len(images) == 0 or images.colors[0].size == 0:
        raise DatasetError("the dataset holds no pixels", reason="DATASET_NO_FRAMES")
    rotation = images.T_world_camera[:, :3, :3]
    product = rotation @ rotation.transpose(0, 2, 1)
    # not (a <= b): NaN must fail too
    if not (np.isfinite(images.T_world_camera).all() and (np.abs(product - np.eye(3)) <= 1e-3).all()):
        raise DatasetError("a camera's pose is not finite, or not a rotation", reason="DATASET_POSE_NOT_RIGID")
    focal = images.intrinsics[:, [0, 1], [0, 1]]
    if not (np.isfinite(images.intrinsics).all() and (focal > 0.0).all()):
        raise DatasetError("a camera's focal length is not positive", reason="DATASET_INTRINSICS_INVALID")
    check_bounds(images.bounds)
    if images.depths is not None:
        if not np.isfinite(images.depths).all() or (images.depths > 0).mean() < _MIN_DEPTH_SHARE:
            raise DatasetError("no image has enough depth measurements", reason="DATASET_DEPTH_MISSING")
    elif float(images.colors.reshape(-1, 3).std(axis=0).max()) < _MIN_SPREAD:
        raise DatasetError("the images have no depths and are all of one color", reason="DATASET_NO_COLOR_VARIETY")


def check_seen(images: PosedImages, shown: int) -> None:
    """Raise DatasetError (DATASET_NOTHING_IN_BOUNDS) when too few pixels show anything within the bounds.

    shown: how many do. The message says where depths end, and in which unit they would end within.
    """
    if shown >= _MIN_PIXELS:
        return
    text = f"only {shown} pixels show a surface within the bounds, {_box(images.bounds)}"
    is_default = np.array_equal(images.bounds, USUAL_BOUNDS)
    if is_default:
        text += " (the default where meta_data.json has no scene_box)"
    origins, rays, depths = sampled_rays(images)
    if len(depths) == 0:
        hint = None if images.masks is None else "Masks are true on the object. Check whether these are inverted."
        raise DatasetError(text, reason="DATASET_NOTHING_IN_BOUNDS", hint=hint)
    ends = np.quantile(origins + depths[:, None] * rays, [0.05, 0.95], axis=0)
    text += f"; depths are {np.median(depths):.4g} in the median and end within {_box(ends)}"
    if is_default:  # nobody chose these bounds: that another unit would fit them says nothing
        box = json.dumps({"scene_box": {"aabb": np.round(ends, 3).tolist()}})[1:-1]
        hint = f"Give the region of the field in meta_data.json. Around the depths it is {box}"
    else:
        hint = _unit_hint(images, origins, rays, depths)
    raise DatasetError(text, reason="DATASET_NOTHING_IN_BOUNDS", hint=hint)


def sampled_rays(images: PosedImages) -> tuple[Floats, Floats, Floats]:
    """Origins (R, 3), directions (R, 3) and depths (R,) of some of the pixels that have a depth, world frame; a
    direction's part along the camera's axis is 1. None without depths."""
    if images.depths is None:
        return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
    chosen = np.flatnonzero(images.measured)
    pixels = np.unravel_index(chosen[:: max(1, len(chosen) // _SAMPLED)], images.depths.shape)
    return *images.rays(*pixels), images.depths[pixels].astype(np.float64)


def _unit_hint(images: PosedImages, origins: Floats, rays: Floats, depths: Floats) -> str | None:
    """The mistaken unit that most depths would end within the bounds without, and by which the images agree best; None
    where there is none."""
    found: list[tuple[float, float, str]] = []
    for factor, unit in UNITS:
        for name, of_origins, of_depths in (
            ("the depths", 1.0, factor), ("the poses", factor, 1.0), ("depths and poses", factor, factor)
        ):  # fmt: skip
            ends = of_origins * origins + of_depths * depths[:, None] * rays
            within = float(((ends >= images.bounds[0]) & (ends <= images.bounds[1])).all(axis=1).mean())
            told = f"divided by {1 / factor:.4g}" if factor < 1.0 else f"times {factor:.4g}"
            share = f"{100 * within:.0f} % of the depths end within the bounds"
            text = f"Are {name} in {unit}? {told[0].upper()}{told[1:]}, {share}."
            found.append((within, of_depths / of_origins, text))
    most = max(within for within, _, _ in found)
    if most < _EXPLAINED:
        return None
    explaining = [(factor, text) for within, factor, text in found if within > 0.95 * most]
    return max(explaining, key=lambda one: score_of_scale(images, one[0]))[1]  # the first of equals


def _box(corners: Floats) -> str:
    """Lowest and highest corner (2, 3) in words."""
    return " to ".join("(" + ", ".join(f"{number:.4g}" for number in corner) + ")" for corner in corners)


def check_bounds(bounds: Floats) -> None:
    """Raise DatasetError (DATASET_BOUNDS_EMPTY) for bounds (2, 3) without volume."""
    if not (np.isfinite(bounds).all() and (bounds[0] < bounds[1]).all()):
        raise DatasetError("the dataset's bounds are empty", reason="DATASET_BOUNDS_EMPTY")
