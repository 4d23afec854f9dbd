"""Posed images written in sdfstudio's format: what benchmarks and tests read again."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from regnf_core.errors import DatasetError
from regnf_data.posed_images import Instance, PosedImages
from regnf_data.sdfstudio import METADATA


def write_dataset(images: PosedImages, folder: str | os.PathLike[str]) -> None:
    """Write ``meta_data.json``, colors and masks as PNG, depths as ``.npy`` in world units.

    All of it or nothing: the folder appears when it is whole. It may exist if it is empty.
    Raises DatasetError (DATASET_FOLDER_NOT_EMPTY) and OSError.
    """
    target = Path(folder)
    check_target(target)
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=f".{target.name}-") as work:
        made = Path(work) / "dataset"
        made.mkdir()  # with the usual rights: a temporary folder is the owner's alone
        frames = [_write_frame(images, index, made) for index in range(len(images))]
        (made / METADATA).write_text(json.dumps(_written_metadata(images, frames), indent=1) + "\n", encoding="utf-8")
        os.replace(made, target)


def check_target(folder: Path) -> None:
    """Raises DatasetError (DATASET_FOLDER_NOT_EMPTY) where a dataset would mix with other files, and OSError."""
    if folder.is_symlink() or (folder.exists() and (not folder.is_dir() or any(folder.iterdir()))):
        raise DatasetError(f"{folder} exists and is not an empty folder", reason="DATASET_FOLDER_NOT_EMPTY")
    if not folder.parent.is_dir():
        raise DatasetError(f"no such folder: {folder.parent}", reason="DATASET_FOLDER_MISSING")


def _write_frame(images: PosedImages, index: int, folder: Path) -> dict[str, Any]:
    intrinsics = np.eye(4)
    intrinsics[:3, :3] = images.intrinsics[index]
    name = f"{index:06d}"
    frame: dict[str, Any] = {
        "rgb_path": f"{name}_rgb.png",
        "camtoworld": images.T_world_camera[index].tolist(),
        "intrinsics": intrinsics.tolist(),
    }
    Image.fromarray(images.colors[index]).save(folder / frame["rgb_path"])
    if images.depths is not None:
        frame["sensor_depth_path"] = f"{name}_depth.npy"
        np.save(folder / frame["sensor_depth_path"], images.depths[index])
    if images.masks is not None:
        frame["foreground_mask"] = f"{name}_mask.png"
        Image.fromarray(images.masks[index].astype(np.uint8) * 255).save(folder / frame["foreground_mask"])
    return frame


def _written_metadata(images: PosedImages, frames: list[dict[str, Any]]) -> dict[str, Any]:
    known = {} if images.T_metric_world is None else {"worldtogt": images.T_metric_world.tolist()}
    return {
        "camera_model": "OPENCV",
        "height": images.size[0],
        "width": images.size[1],
        "has_sensor_depth": images.depths is not None,
        "has_foreground_mask": images.masks is not None,
        "scene_box": _scene_box(images),
        **known,
        "instances": [write_instance(instance) for instance in images.instances],
        "frames": frames,
    }


def _scene_box(images: PosedImages) -> dict[str, Any]:
    """``near`` and ``far`` hold every point of the bounds from every camera; regnf itself reads ``aabb`` alone."""
    lower, upper = images.bounds
    positions = images.T_world_camera[:, :3, 3]
    outside = np.maximum(np.maximum(lower - positions, positions - upper), 0.0)
    farthest = np.maximum(np.abs(positions - lower), np.abs(positions - upper))
    radius = float(np.linalg.norm(upper - lower)) / 2.0
    return {
        "aabb": images.bounds.tolist(),
        "near": max(float(np.linalg.norm(outside, axis=1).min()), 0.01 * radius),
        "far": float(np.linalg.norm(farthest, axis=1).max()),
        "radius": radius,
        "collider_type": "box",
    }


def write_instance(instance: Instance) -> dict[str, Any]:
    """One instance as the metadata holds it. ``box_min`` and ``box_max`` bound the corners along the world's axes."""
    box = instance.box
    corners = box.corners().numpy()
    written: dict[str, Any] = {
        "label": instance.label,
        "box_min": corners.min(axis=0).tolist(),
        "box_max": corners.max(axis=0).tolist(),
        "box_corners": corners.tolist(),
        # The three above lose the last digits, and the box's own axes; this is what regnf reads back.
        "box": {"center": box.center.tolist(), "size": box.size.tolist(), "rotation": box.rotation.tolist()},
    }
    matrices = {name: getattr(instance, name) for name in ("T_object_world", "world_pose", "gt_pose")}
    return written | {name: np.asarray(T).tolist() for name, T in matrices.items() if T is not None}
