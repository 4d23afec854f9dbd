"""A made-up registration: a chair in the corner of a room, and everything a finished job would leave behind.

Written independently of the engine, so that the page is tested against the documented shapes of the documents.
"""

from __future__ import annotations

import io
import json
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.transformations import quaternion_from_matrix, rotation_matrix

from regnf_core.viewing.field_views import mesh_file

Array = NDArray[Any]

ITERATIONS = 40
JOB_ID = "5f0c1d2e9a7b4c3d8e6f5a4b3c2d1e0f"
PHASE_SECONDS = {
    "loading": 0.41, "sampling": 2.13, "initializing": 3.02, "optimizing": 5.74, "verifying": 0.66, "exporting": 0.38,
}  # fmt: skip
_SPACING = 0.018


def rotation(axis: list[float], angle: float) -> Array:
    turn: Array = rotation_matrix(angle, axis)[:3, :3]
    return turn


def similarity(scale: float, turn: Array, shift: list[float]) -> Array:
    """The (4, 4) matrix of x -> scale * turn x + shift."""
    matrix = np.eye(4)
    matrix[:3, :3] = scale * turn
    matrix[:3, 3] = shift
    return matrix


def sim3_document(matrix: Array) -> dict[str, Any]:
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    w, x, y, z = quaternion_from_matrix(similarity(1.0, matrix[:3, :3] / scale, [0, 0, 0])).tolist()
    parts = {"rotation_quaternion_xyzw": [x, y, z, w], "translation": matrix[:3, 3].tolist()}
    return {"matrix": matrix.tolist(), "scale": scale, **parts}


CHAIR_IN_SCENE = similarity(1.0, rotation([0, 0, 1], math.radians(-125)), [0.25, 0.1, 0.0])
LIBRARY_FROM_CHAIR = similarity(1.6, rotation([0, 0, 1], math.radians(30)), [0.0, 0.0, -0.72])


# what stands there


def _boxes(*corners: list[float]) -> trimesh.Trimesh:
    made = [trimesh.creation.box(bounds=[corner[:3], corner[3:]]) for corner in corners]
    mesh = trimesh.util.concatenate(made)
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh


def chair(placed: Array) -> trimesh.Trimesh:
    """A chair about 0.9 high that stood on z = 0, facing +y, before it was placed; its one arm breaks the symmetry."""
    legs = [[x - 0.022, y - 0.022, 0.0, x + 0.022, y + 0.022, 0.42 if y > 0 else 0.92]
            for x in (-0.21, 0.21) for y in (-0.21, 0.21)]  # fmt: skip
    slats = [[-0.19, -0.225, z, 0.19, -0.2, z + 0.07] for z in (0.58, 0.70, 0.82)]
    arm = [[0.22, -0.21, 0.64, 0.26, 0.16, 0.67], [0.225, 0.1, 0.47, 0.255, 0.14, 0.64]]
    whole = _boxes([-0.24, -0.24, 0.42, 0.24, 0.24, 0.47], *legs, *slats, *arm)
    whole.apply_transform(placed)
    return whole


def room() -> trimesh.Trimesh:
    """A floor, two walls and a low table, for the chair to stand between."""
    return _boxes(
        [-1.6, -1.6, -0.05, 1.6, 1.6, 0.0], [-1.65, -1.6, 0.0, -1.6, 1.6, 1.5], [-1.6, -1.65, 0.0, 1.6, -1.6, 1.5],
        [-1.2, -1.1, 0.35, -0.4, -0.6, 0.4], [-0.84, -0.89, 0.0, -0.76, -0.81, 0.35],
    )  # fmt: skip


def scene_mesh() -> bytes:
    both = trimesh.util.concatenate([room(), chair(CHAIR_IN_SCENE)])
    return mesh_file(both.vertices, both.faces)


def object_mesh() -> bytes:
    alone = chair(LIBRARY_FROM_CHAIR)
    return mesh_file(alone.vertices, alone.faces)


def _samples(mesh: trimesh.Trimesh, spacing: float) -> tuple[Array, Array]:
    """Points (N, 3) on a surface, about ``spacing`` apart, and their normals (N, 3)."""
    points, faces = trimesh.sample.sample_surface_even(mesh, int(mesh.area / spacing**2), seed=7)
    return np.asarray(points), np.asarray(mesh.face_normals[faces])


def _ply(points: Array, normals: Array, color: tuple[int, int, int]) -> bytes:
    reals, colors = ("x", "y", "z", "nx", "ny", "nz"), ("red", "green", "blue")
    rows = np.empty(len(points), [(name, "<f4") for name in reals] + [(name, "u1") for name in colors])
    for name, values in zip((*reals, *colors), (*points.T, *normals.T, *color), strict=True):
        rows[name] = values
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    lines += [f"property float {name}" for name in reals] + [f"property uchar {name}" for name in colors]
    return ("\n".join([*lines, "end_header"]) + "\n").encode() + rows.tobytes()


# what a job leaves behind


@dataclass(frozen=True)
class Synthetic:
    result: dict[str, Any]
    detection: dict[str, Any]
    artifacts: dict[str, bytes]
    T_object_scene: Array


def _path(final_in_scene: Array) -> list[Array]:
    """The object's poses in the scene over the iterations, from a bad start into place."""
    left = [math.exp(-step / 7.0) for step in range(ITERATIONS)] + [0.0]
    shift = np.array([0.42, 0.3, 0.28])
    wrong = [similarity(1.0 + 0.35 * one, rotation([0.25, 0.1, 1.0], one), list(one * shift)) for one in left]
    return [final_in_scene @ one for one in wrong]


def _trace(poses: list[Array]) -> list[dict[str, Any]]:
    def row(step: int, left: float) -> dict[str, Any]:
        loss = 0.18 * left + 2.1e-4 * (1 + 0.3 * math.sin(step))
        residuals = {"residual_scene": 0.08 * left + 3e-3, "residual_object": 0.07 * left + 3e-3}
        found = sim3_document(np.linalg.inv(poses[step]))
        return {"iteration": step, "loss": loss, **residuals, "T_object_scene": found}

    return [row(step, math.exp(-step / 5.0)) for step in range(1, len(poses))]


def _npz(**arrays: Array) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **{name: np.float32(a) if a.dtype.kind == "f" else a for name, a in arrays.items()})
    return buffer.getvalue()


def _residuals(points: Array, rng: np.random.Generator) -> Array:
    sizes: Array = rng.normal(0.0, 0.004, len(points)) + 0.02 * (points[:, 2] > np.quantile(points[:, 2], 0.8))
    return sizes


def synthetic() -> Synthetic:
    rng = np.random.default_rng(7)
    T_scene_object = CHAIR_IN_SCENE @ np.linalg.inv(LIBRARY_FROM_CHAIR)
    T_object_scene = np.linalg.inv(T_scene_object)
    seen, seen_normals = _samples(chair(CHAIR_IN_SCENE), _SPACING)
    seen = seen + rng.normal(0, 0.0025, seen.shape)
    around, around_normals = _samples(room(), _SPACING * 2.4)
    library, library_normals = _samples(chair(LIBRARY_FROM_CHAIR), 1.6 * _SPACING)
    poses = _path(T_scene_object)
    scene = np.concatenate([seen, around]), np.concatenate([seen_normals, around_normals])
    artifacts = {
        "scene_points.ply": _ply(*scene, (150, 150, 150)),
        "object_points.ply": _ply(library, library_normals, (60, 130, 220)),
        "trace.json": json.dumps(_trace(poses)).encode(),
        "residuals.npz": _npz(
            scene_points=seen, scene_residuals=_residuals(seen, rng),
            object_points=library, object_residuals=_residuals(library, rng),
        ),
    }  # fmt: skip
    result = _result(T_scene_object, np.linalg.inv(poses[0]), artifacts)
    # Held, but listed each by the one story that has it. Of two poses, nothing speaks against the first, everything
    # against the second.
    signs = np.array([[0], [1]], np.uint8).repeat(300, 1)
    artifacts["considered.npz"] = _npz(
        scene_points=seen[:300], object_points=library[:300], scene_signs=signs, object_signs=signs
    )
    artifacts["context_points.ply"] = _ply(around, around_normals, (200, 200, 200))
    low, high = seen.min(axis=0) - 0.04, seen.max(axis=0) + 0.04
    detection = {
        "center": ((low + high) / 2).tolist(), "size": (high - low).tolist(),
        "rotation_quaternion_xyzw": [0.0, 0.0, 0.0, 1.0], "label": "chair",
    }  # fmt: skip
    return Synthetic(result, detection, artifacts, T_object_scene)


def _result(T_scene_object: Array, initial: Array, artifacts: dict[str, bytes]) -> dict[str, Any]:
    return {
        "verdict": "registered", "verdict_reason": "SURFACES_AGREE", "probability": 0.973, "level": "default",
        "center_scene": T_scene_object[:3, 3].tolist(), "center_object": [0.0, 0.0, 0.0],
        "T_object_scene": sim3_document(np.linalg.inv(T_scene_object)), "T_scene_object": sim3_document(T_scene_object),
        "T_object_scene_initial": sim3_document(initial), "alternatives": [],
        "metrics": {
            "residual_rms": 0.00412, "inlier_share_scene": 0.962, "inlier_share_object": 0.931, "probability": 0.973,
            "iterations": float(ITERATIONS), "field_evaluations": 1_843_200.0,
            **{f"seconds_{phase}": value for phase, value in PHASE_SECONDS.items()},
        },
        "seed": 7, "engine": {"version": "0.1.0", "preset": "robust", "device": "cpu"},
        "artifacts": [{"name": name, "bytes": len(data)} for name, data in artifacts.items()],
    }  # fmt: skip
