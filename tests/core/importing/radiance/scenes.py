"""A thing on a floor as the trainers of radiance fields leave it: checkpoints, snapshots, and the cameras."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tests.core.importing.radiance.fitted import Doubles, Fitted, Grid, boxes, fitted, ring

FLOOR = -0.3
YAW, PLACE = 0.5, np.array([0.1, -0.05, FLOOR])
TURN = np.array([[np.cos(YAW), -np.sin(YAW), 0.0], [np.sin(YAW), np.cos(YAW), 0.0], [0.0, 0.0, 1.0]])
STAIR = (
    ([-0.3, -0.2, 0.0], [0.3, 0.2, 0.15]),
    ([-0.3, -0.2, 0.15], [-0.05, 0.2, 0.4]),
    ([0.1, 0.0, 0.15], [0.3, 0.2, 0.27]),
)
"""A thing without symmetry, that stands on z = 0."""
SCALE = 0.4
T_TRAINER_DATASET = np.array([[0.0, 1.0, 0.0, 0.1], [-1.0, 0.0, 0.0, -0.2], [0.0, 0.0, 1.0, -0.5]])
"""And then times SCALE: from the dataset's coordinates, as dataparser_transforms.json has it."""
HASH = {"num_levels": 8, "features_per_level": 2, "log2_hashmap_size": 15, "base_res": 8, "max_res": 220}


def distance(points: Doubles) -> Doubles:
    """To the floor and the thing on it, in the trainer's coordinates."""
    return np.minimum(points[:, 2] - FLOOR, boxes(*STAIR)((points - PLACE) @ TURN))


def contracted(points: Doubles) -> Doubles:
    size = np.abs(points).max(axis=1, keepdims=True).clip(1.0)
    return (2.0 - 1.0 / size) * points / size


def places() -> Doubles:
    """Where the density is fitted: mostly near the surface."""
    random = np.random.default_rng(0)
    wide = random.uniform(-1.5, 1.5, (14_000, 3))
    near = random.uniform(-1.5, 1.5, (120_000, 3))
    thing = PLACE + random.uniform([-0.4, -0.3, 0.0], [0.4, 0.3, 0.5], (14_000, 3)) @ TURN.T
    return np.concatenate([wide, near[np.abs(distance(near)) < 0.08][:14_000], thing])


@cache
def nerfacto(tiny: bool, is_contracted: bool = True, factor: float = 0.01) -> Fitted:
    points = places()
    unit = (contracted(points) + 2.0) / 4.0 if is_contracted else (points + 1.5) / 3.0
    return fitted(Grid(tiny), distance, points, unit, factor)


def state_of(field: Fitted, names: str = "model") -> dict[str, torch.Tensor]:
    """A checkpoint's tensors below ``_model.field.``, with some that no geometry needs."""
    grid, network = field.grid, field.network
    state: dict[str, Any] = {"aabb": [[-1.5] * 3, [1.5] * 3], "embedding_appearance.weight": np.zeros((4, 32))}
    if names == "model" and not grid.tiny:
        state["mlp_base.model.0.hash_table"] = field.table
        layers = "mlp_base.model.1.layers."
    elif names == "model":
        state["mlp_base.model.params"] = field.flat()
    elif names == "params":
        state["mlp_base.params"] = field.flat()
    elif grid.tiny:
        state["mlp_base.0.tcnn_encoding.params"] = field.table.ravel()
        state["mlp_base.1.tcnn_encoding.params"] = field.flat()[: -field.table.size]
    else:
        state["mlp_base.0.hash_table"] = field.table
        layers = "mlp_base.1.layers."
    if not grid.tiny:
        pairs = ((network.first, network.first_bias), (network.last, network.last_bias))
        for number, (weight, bias) in enumerate(pairs):
            state |= {f"{layers}{number}.weight": weight, f"{layers}{number}.bias": bias}
    tensors = {name: torch.as_tensor(np.asarray(value), dtype=torch.float32) for name, value in state.items()}
    stored = {"max_res": grid.top, "num_levels": grid.levels, "log2_hashmap_size": grid.log2}
    return tensors | {name: torch.tensor(value) for name, value in stored.items()}


def checkpoint(path: Path, state: dict[str, torch.Tensor], prefix: str = "_model.field.") -> Path:
    torch.save({"step": 29999, "pipeline": {prefix + name: value for name, value in state.items()}}, path)
    return path


def config(**more: Any) -> str:
    """config.yml, as nerfstudio dumps it."""
    model = {**HASH, "average_init_density": 0.01, "disable_scene_contraction": False, **more}
    lines = [f"    {name}: {json.dumps(value)}" for name, value in model.items()]
    head = "!!python/object:nerfstudio.engine.trainer.TrainerConfig\nmethod_name: nerfacto\npipeline:\n"
    target = "    _target: !!python/name:nerfstudio.models.nerfacto.NerfactoModel ''\n"
    return f"{head}  model: !!python/object:nerfstudio.models.nerfacto.NerfactoModelConfig\n{target}" + "\n".join(lines)


def transforms(poses: list[Doubles]) -> dict[str, Any]:
    frames = [{"file_path": f"{number}.png", "transform_matrix": pose.tolist()} for number, pose in enumerate(poses)]
    return {
        "camera_model": "OPENCV",
        "fl_x": 500,
        "fl_y": 500,
        "cx": 320,
        "cy": 240,
        "w": 640,
        "h": 480,
        "frames": frames,
    }


def cameras(count: int = 24) -> list[Doubles]:
    """In the trainer's coordinates."""
    return ring(count, 0.8, 0.5, PLACE)


def into_dataset(pose: Doubles) -> Doubles:
    """A pose in the trainer's coordinates, in those of the dataset."""
    turn, shift = T_TRAINER_DATASET[:, :3], T_TRAINER_DATASET[:, 3]
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = turn.T @ pose[:3, :3], turn.T @ (pose[:3, 3] / SCALE - shift)
    return found
