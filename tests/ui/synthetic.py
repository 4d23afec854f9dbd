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
from numpy.typing import NDArray

Array = NDArray[Any]

ITERATIONS = 40
JOB_ID = "5f0c1d2e9a7b4c3d8e6f5a4b3c2d1e0f"
PHASE_SECONDS = {
    "loading": 0.41,
    "sampling": 2.13,
    "initializing": 3.02,
    "optimizing": 5.74,
    "verifying": 0.66,
    "exporting": 0.38,
}


def box_surface(
    lower: list[float], upper: list[float], spacing: float, rng: np.random.Generator, faces: str = "-x +x -y +y -z +z"
) -> tuple[Array, Array]:
    """Points (N, 3) and outward normals (N, 3) on the named faces of a box: a jittered grid ``spacing`` apart."""
    low, high = np.array(lower), np.array(upper)
    size = high - low
    points, normals = [], []
    for axis in range(3):
        u, v = [i for i in range(3) if i != axis]
        across, along = (max(round(size[i] / spacing), 1) for i in (u, v))
        grid = np.stack(np.meshgrid(np.arange(across), np.arange(along)), -1).reshape(-1, 2)
        for side, sign in ((low, -1.0), (high, 1.0)):
            if f"{'-' if sign < 0 else '+'}{'xyz'[axis]}" not in faces:
                continue
            share = (grid + rng.uniform(0.15, 0.85, grid.shape)) / (across, along)
            face = np.tile(side, (len(grid), 1))
            face[:, [u, v]] = low[[u, v]] + share * size[[u, v]]
            normal = np.zeros_like(face)
            normal[:, axis] = sign
            points.append(face)
            normals.append(normal)
    return np.concatenate(points), np.concatenate(normals)


def chair_boxes() -> list[tuple[list[float], list[float]]]:
    """The lower and upper corners of the boxes of a chair standing on z = 0, facing +y, about 0.9 high."""
    boxes: list[tuple[list[float], list[float]]] = [([-0.24, -0.24, 0.42], [0.24, 0.24, 0.47])]
    boxes += [
        ([x - 0.022, y - 0.022, 0.0], [x + 0.022, y + 0.022, 0.42 if y > 0 else 0.92])
        for x in (-0.21, 0.21)
        for y in (-0.21, 0.21)
    ]
    boxes += [([-0.19, -0.225, z], [0.19, -0.2, z + 0.07]) for z in (0.58, 0.70, 0.82)]
    boxes += [
        ([0.22, -0.21, 0.64], [0.26, 0.16, 0.67]),
        ([0.225, 0.1, 0.47], [0.255, 0.14, 0.64]),
    ]  # one arm: no symmetry
    return boxes


def chair(spacing: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Points on the chair and their normals."""
    parts = [box_surface(low, high, spacing, rng) for low, high in chair_boxes()]
    return np.concatenate([p for p, _ in parts]), np.concatenate([n for _, n in parts])


def room(spacing: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """A floor, two walls and a low table, for the chair to stand between; normals into the room."""
    parts = [
        box_surface([-1.6, -1.6, -0.05], [1.6, 1.6, 0.0], spacing, rng, "+z"),
        box_surface([-1.65, -1.6, 0.0], [-1.6, 1.6, 1.5], spacing, rng, "+x"),
        box_surface([-1.6, -1.65, 0.0], [1.6, -1.6, 1.5], spacing, rng, "+y"),
        box_surface([-1.2, -1.1, 0.35], [-0.4, -0.6, 0.4], spacing, rng),
        box_surface([-0.84, -0.89, 0.0], [-0.76, -0.81, 0.35], spacing, rng),
    ]
    return np.concatenate([p for p, _ in parts]), np.concatenate([n for _, n in parts])


def rotation(axis: list[float], angle: float) -> Array:
    """The rotation matrix (3, 3) about an axis, by Rodrigues' formula."""
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn: Array = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    return turn


def similarity(scale: float, turn: Array, shift: list[float]) -> Array:
    """The (4, 4) matrix of x -> scale * turn x + shift."""
    matrix = np.eye(4)
    matrix[:3, :3] = scale * turn
    matrix[:3, 3] = shift
    return matrix


def move(matrix: Array, points: Array) -> Array:
    moved: Array = points @ matrix[:3, :3].T + matrix[:3, 3]
    return moved


def sim3_document(matrix: Array) -> dict[str, Any]:
    """As the API writes it: the matrix and its parts."""
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    turn = matrix[:3, :3] / scale
    w = math.sqrt(max(0.0, 1 + turn[0, 0] + turn[1, 1] + turn[2, 2])) / 2
    x, y, z = ((turn[2, 1] - turn[1, 2]), (turn[0, 2] - turn[2, 0]), (turn[1, 0] - turn[0, 1]))
    quaternion = [float(part / (4 * w)) for part in (x, y, z)] + [w]
    return {
        "matrix": matrix.tolist(),
        "scale": scale,
        "rotation_quaternion_xyzw": quaternion,
        "translation": matrix[:3, 3].tolist(),
    }


def ply(points: Array, normals: Array, color: tuple[int, int, int]) -> bytes:
    """A binary little-endian PLY file: x y z nx ny nz red green blue."""
    kind = [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")] + [(name, "u1") for name in ("r", "g", "b")]
    rows = np.empty(len(points), dtype=kind)
    for i, name in enumerate(("x", "y", "z")):
        rows[name], rows[f"n{name}"] = points[:, i], normals[:, i]
    for name, part in zip(("r", "g", "b"), color, strict=True):
        rows[name] = part
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    lines += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    lines += [f"property uchar {name}" for name in ("red", "green", "blue")]
    return ("\n".join([*lines, "end_header"]) + "\n").encode() + rows.tobytes()


CHAIR_IN_SCENE = similarity(1.0, rotation([0, 0, 1], math.radians(-125)), [0.25, 0.1, 0.0])
LIBRARY_FROM_CHAIR = similarity(1.6, rotation([0, 0, 1], math.radians(30)), [0.0, 0.0, -0.72])


@dataclass(frozen=True)
class Synthetic:
    """What the fixture serves: the result document, the detection and the artifacts' bytes."""

    result: dict[str, Any]
    detection: dict[str, Any]
    artifacts: dict[str, bytes]
    T_object_scene: Array
    T_object_scene_initial: Array


def _path(final_in_scene: Array) -> list[Array]:
    """The object's poses in the scene over the iterations, from a bad start into place."""
    poses = []
    for step in range(ITERATIONS + 1):
        left = math.exp(-step / 7.0) if step < ITERATIONS else 0.0
        wrong = similarity(
            1.0 + 0.35 * left,
            rotation([0.25, 0.1, 1.0], 1.0 * left),
            [0.42 * left, 0.3 * left, 0.28 * left],
        )
        poses.append(final_in_scene @ wrong)
    return poses


def _trace(poses: list[Array]) -> list[dict[str, Any]]:
    rows = []
    for step, pose in enumerate(poses[1:], start=1):
        left = math.exp(-step / 5.0)
        rows.append(
            {
                "iteration": step,
                "loss": 0.18 * left + 2.1e-4 * (1 + 0.3 * math.sin(step)),
                "residual_scene": 0.08 * left + 3e-3,
                "residual_object": 0.07 * left + 3e-3,
                "T_object_scene": sim3_document(np.linalg.inv(pose)),
            }
        )
    return rows


def _residuals(scene: Array, obj: Array, rng: np.random.Generator) -> bytes:
    def sizes(points: Array) -> Array:
        made: Array = rng.normal(0.0, 0.004, len(points)) + 0.02 * (points[:, 2] > np.quantile(points[:, 2], 0.8))
        return made

    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        scene_points=scene.astype(np.float32),
        scene_residuals=sizes(scene).astype(np.float32),
        object_points=obj.astype(np.float32),
        object_residuals=sizes(obj).astype(np.float32),
    )
    return buffer.getvalue()


def _considered(scene: Array, obj: Array) -> bytes:
    """Of two poses: nothing speaks against the first, everything against the second."""
    signs = {f"{side}_signs": np.array([[0], [1]], np.uint8).repeat(300, 1) for side in ("scene", "object")}
    packed = io.BytesIO()
    np.savez(packed, scene_points=scene[:300].astype(np.float32), object_points=obj[:300].astype(np.float32), **signs)
    return packed.getvalue()


def _detection(seen: Array) -> dict[str, Any]:
    low, high = seen.min(axis=0) - 0.04, seen.max(axis=0) + 0.04
    return {
        "center": ((low + high) / 2).tolist(),
        "size": (high - low).tolist(),
        "rotation_quaternion_xyzw": [0.0, 0.0, 0.0, 1.0],
        "label": "chair",
    }


def _result(T_scene_object: Array, initial: Array, artifacts: dict[str, bytes]) -> dict[str, Any]:
    return {
        "verdict": "registered",
        "verdict_reason": "SURFACES_AGREE",
        "probability": 0.973,
        "center_scene": (T_scene_object @ [0.0, 0.0, 0.0, 1.0])[:3].tolist(),
        "center_object": [0.0, 0.0, 0.0],
        "T_object_scene": sim3_document(np.linalg.inv(T_scene_object)),
        "T_scene_object": sim3_document(T_scene_object),
        "T_object_scene_initial": sim3_document(initial),
        "alternatives": [],
        "metrics": {
            "residual_rms": 0.00412,
            "inlier_share_scene": 0.962,
            "inlier_share_object": 0.931,
            "probability": 0.973,
            "iterations": float(ITERATIONS),
            "field_evaluations": 1_843_200.0,
            **{f"seconds_{phase}": value for phase, value in PHASE_SECONDS.items()},
        },
        "seed": 7,
        "engine": {"version": "0.1.0", "preset": "robust", "device": "cpu"},
        "artifacts": [{"name": name, "bytes": len(data)} for name, data in artifacts.items()],
    }


def synthetic(seed: int = 7, spacing: float = 0.018) -> Synthetic:
    """The whole made-up registration; deterministic for ``seed``."""
    rng = np.random.default_rng(seed)
    chair_in_scene, library_from_chair = CHAIR_IN_SCENE, LIBRARY_FROM_CHAIR
    T_scene_object = chair_in_scene @ np.linalg.inv(library_from_chair)
    T_object_scene = np.linalg.inv(T_scene_object)

    seen, seen_normals = chair(spacing, rng)
    seen = move(chair_in_scene, seen) + rng.normal(0, 0.0025, seen.shape)
    seen_normals = seen_normals @ chair_in_scene[:3, :3].T
    around, around_normals = room(spacing * 1.9, rng)
    scene, scene_normals = np.concatenate([seen, around]), np.concatenate([seen_normals, around_normals])
    library, library_normals = chair(spacing, rng)
    library = move(library_from_chair, library)
    library_normals = library_normals @ rotation([0, 0, 1], math.radians(30)).T

    poses = _path(T_scene_object)
    initial = np.linalg.inv(poses[0])
    artifacts = {
        "scene_points.ply": ply(scene, scene_normals, (150, 150, 150)),
        "object_points.ply": ply(library, library_normals, (60, 130, 220)),
        "trace.json": json.dumps(_trace(poses)).encode(),
        "residuals.npz": _residuals(seen, library, rng),
    }
    result = _result(T_scene_object, initial, artifacts)
    artifacts["considered.npz"] = _considered(seen, library)  # listed by the one story that has it
    # Held, but listed by the one story that has it: older results have no surroundings.
    artifacts["context_points.ply"] = ply(around, around_normals, (200, 200, 200))
    return Synthetic(result, _detection(seen), artifacts, T_object_scene, initial)
