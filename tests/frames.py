"""A thing on a table in depth images, with the truth: an L of two blocks and a knob, 16 cm long, seen from one side."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image

from benchmarks.worlds.mesh_scene import MeshScene, PaintedMesh, Thing, box_thing, tile_paint, vertex_paint
from benchmarks.worlds.rendering import render
from benchmarks.worlds.trajectories import look_at

H, W = 180, 240
K = np.array([[230.0, 0.0, 120.0], [0.0, 230.0, 90.0], [0.0, 0.0, 1.0]])
"""Pixel centers at + .5."""
CAMERA = {"fx": 230.0, "fy": 230.0, "cx": 119.5, "cy": 89.5, "width": W, "height": H}
"""As a file has it: pixel centers at whole numbers."""


@dataclass(frozen=True, eq=False)
class Shot:
    """depth: (H, W) m · color: (H, W, 3) · mask: (H, W) · T_world_camera: (4, 4) · T_world_object: (4, 4), of the model
    in meters."""

    depth: NDArray[np.float32]
    color: NDArray[np.uint8]
    mask: NDArray[np.bool_]
    T_world_camera: NDArray[np.float64]
    T_world_object: NDArray[np.float64]

    @property
    def T_camera_object(self) -> NDArray[np.float64]:
        return np.linalg.inv(self.T_world_camera) @ self.T_world_object

    @property
    def box_2d(self) -> list[int]:
        rows, columns = np.nonzero(self.mask)
        return [int(v) for v in (columns.min() - 3, rows.min() - 3, columns.max() + 4, rows.max() + 4)]


@cache
def model() -> trimesh.Trimesh:
    """The thing, meters."""
    parts = [((0.0, 0.0, 0.03), (0.16, 0.06, 0.06)), ((-0.05, 0.0, 0.09), (0.06, 0.06, 0.08)),
             ((0.05, 0.045, 0.02), (0.03, 0.04, 0.03))]  # fmt: skip
    blocks = [trimesh.creation.box(size, trimesh.transformations.translation_matrix(at)) for at, size in parts]
    return trimesh.util.concatenate(blocks)


@cache
def shots(count: int = 1) -> tuple[Shot, ...]:
    """Cameras on an arc before the table."""
    T = np.eye(4)
    c, s = np.cos(0.6), np.sin(0.6)
    T[:2, :2], T[:3, 3] = [[c, -s], [s, c]], (0.05, 0.02, 0.0)
    mesh = model().copy()
    mesh.apply_transform(T)
    gray = np.full((len(mesh.vertices), 3), 0.5)
    thing = Thing((PaintedMesh(mesh.vertices, mesh.faces, vertex_paint(gray)),), None)  # type: ignore[arg-type]
    scene = MeshScene(
        [
            thing,
            box_thing([-0.6, -0.6, -0.05], [0.6, 0.6, 0.0], tile_paint((0.6, 0.5, 0.4), (0.4, 0.3, 0.2), 0.1)),
            box_thing([-2.0, -2.0, -0.8], [2.0, 2.0, -0.75], tile_paint((0.3, 0.3, 0.3), (0.2, 0.2, 0.2), 0.2)),
        ]
    )
    found = []
    for angle in np.linspace(0.3, 1.5, count):
        eye = np.array([[0.6 * np.cos(angle), -0.6 * np.sin(angle), 0.45]])
        pose = look_at(eye, np.array([[0.05, 0.02, 0.05]]))[0]
        view = render(scene, (H, W), K, pose)
        depth = np.where(np.isfinite(view.depth), view.depth, 0.0).astype(np.float32)
        found.append(Shot(depth, view.colors, view.thing == 0, pose, T))
    return tuple(found)


def write_model(folder: Path) -> Path:
    """The thing as an STL file in millimeters."""
    mesh = model().copy()
    mesh.apply_scale(1000.0)
    path = folder / "model.stl"
    mesh.export(path)
    return path


def write_frame(folder: Path, shot: Shot, **camera: Any) -> Path:
    """A folder of one frame: depth.png in millimeters, color.png, camera.json."""
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.round(shot.depth * 1000.0).astype(np.uint16)).save(folder / "depth.png")
    Image.fromarray(shot.color).save(folder / "color.png")
    (folder / "camera.json").write_text(json.dumps(CAMERA | camera))
    return folder


def write_mask(path: Path, shot: Shot) -> Path:
    Image.fromarray(shot.mask.astype(np.uint8) * 255).save(path)
    return path


def error_m(T: Any, truth: NDArray[np.float64], unit: float = 0.001) -> float:
    """How far the thing's vertices are from their places, at most, meters. T: of the model in ``unit``."""
    vertices = np.asarray(model().vertices)
    found, right = np.array(T, np.float64) @ np.diag([1 / unit, 1 / unit, 1 / unit, 1.0]), truth
    apart = vertices @ (found - right)[:3, :3].T + (found - right)[:3, 3]
    return float(np.linalg.norm(apart, axis=1).max())
