"""Scenes in BOP's layout, of depth images and poses; what is visible of an object is measured in its depth image."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from benchmarks.bop.errors import Array, Mesh

_TOLERANCE = 15.0
"""mm: a rendered point that lies so much behind the measured one at most is visible, as in BOP."""


@dataclass(frozen=True, eq=False)
class Placed:
    """An object in an image. pose: (4, 4), object to camera, mm · visible: (H, W) · silhouette: (H, W), with what is
    hidden; None where it is not known."""

    obj_id: int
    pose: Array
    visible: NDArray[np.bool_]
    silhouette: NDArray[np.bool_] | None = None


@dataclass(frozen=True, eq=False)
class Picture:
    """depth: (H, W) mm, 0 where nothing was measured · K: (3, 3), a pixel's center at whole numbers · color: (H, W, 3)
    uint8 or None."""

    depth: Array
    K: Array
    color: NDArray[np.uint8] | None = None


def rendered(mesh: Mesh, pose: Array, picture: Picture) -> Array:
    """(H, W): the depth of a mesh (vertices, faces) under a pose, mm, 0 where it is not."""
    import open3d

    vertices, faces = mesh
    scene = open3d.t.geometry.RaycastingScene()
    moved = vertices @ pose[:3, :3].T + pose[:3, 3]
    scene.add_triangles(moved.astype(np.float32), np.asarray(faces).astype(np.uint32))
    v, u = np.indices(picture.depth.shape).astype(np.float64)
    K = picture.K
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)
    cast = np.concatenate([np.zeros_like(rays), rays], axis=-1).astype(np.float32)
    hit = scene.cast_rays(open3d.core.Tensor(cast), nthreads=1)["t_hit"].numpy()
    return np.where(np.isfinite(hit), hit, 0.0).astype(np.float64)


def placed(picture: Picture, meshes: Sequence[Mesh], obj_ids: Sequence[int], poses: Sequence[Array]) -> list[Placed]:
    """The objects of an image. Visible is the nearest of them, where nothing that was measured is before it."""
    depths = [rendered(mesh, pose, picture) for mesh, pose in zip(meshes, poses, strict=True)]
    stacked = np.stack([np.where(depth > 0.0, depth, np.inf) for depth in depths])
    nearest = stacked.argmin(axis=0)
    out = []
    for number, (obj_id, pose, depth) in enumerate(zip(obj_ids, poses, depths, strict=True)):
        shown = (depth > 0.0) & (nearest == number)
        shown &= (picture.depth == 0.0) | (depth - picture.depth <= _TOLERANCE)
        out.append(Placed(obj_id, pose, shown, depth > 0.0))
    return out


def write_scene(folder: Path, pictures: dict[int, tuple[Picture, Sequence[Placed]]]) -> None:
    """scene_camera.json, scene_gt.json, scene_gt_info.json, depth/ (a tenth of a millimeter), rgb/, mask_visib/."""
    cameras, truths, infos = {}, {}, {}
    for im_id, (picture, objects) in pictures.items():
        name = f"{im_id:06d}"
        cameras[str(im_id)] = {"cam_K": picture.K.ravel().tolist(), "depth_scale": 0.1}
        _image(folder / "depth" / f"{name}.png", np.round(10.0 * picture.depth).astype(np.uint16))
        if picture.color is not None:
            _image(folder / "rgb" / f"{name}.png", picture.color)
        truths[str(im_id)] = [
            {
                "cam_R_m2c": one.pose[:3, :3].ravel().tolist(),
                "cam_t_m2c": one.pose[:3, 3].tolist(),
                "obj_id": one.obj_id,
            }
            for one in objects
        ]
        infos[str(im_id)] = [_info(one) for one in objects]
        for number, one in enumerate(objects):
            _image(folder / "mask_visib" / f"{name}_{number:06d}.png", 255 * one.visible.astype(np.uint8))
    for file, values in (("scene_camera", cameras), ("scene_gt", truths), ("scene_gt_info", infos)):
        (folder / f"{file}.json").write_text(json.dumps(values))


def _info(one: Placed) -> dict[str, Any]:
    rows, columns = np.nonzero(one.visible)
    found: dict[str, Any] = {"bbox_visib": [-1, -1, -1, -1], "px_count_visib": len(rows)}
    if len(rows):
        low, high = (int(columns.min()), int(rows.min())), (int(columns.max()), int(rows.max()))
        found["bbox_visib"] = [*low, high[0] - low[0] + 1, high[1] - low[1] + 1]
    if one.silhouette is not None:
        found["visib_fract"] = len(rows) / max(int(one.silhouette.sum()), 1)
    return found


def _image(path: Path, values: NDArray[Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(values).save(path)
