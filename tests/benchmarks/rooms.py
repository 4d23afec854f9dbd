"""A small room with two chests, as files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

CHEST = np.array([[-0.3, -0.2, 0.0], [0.3, 0.2, 0.5]])
"""The chest in its own frame, meters."""
QUARTER_TURN = [[0.0, -1.0, 0.0, 0.9], [1.0, 0.0, 0.0, 0.6], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]


def write_chest(path: Path) -> Path:
    """A box with a color of its own on every face."""
    box = trimesh.creation.box(bounds=CHEST)
    rng = np.random.default_rng(0)
    box.visual.face_colors = rng.integers(60, 255, (len(box.faces), 4), dtype=np.uint8)
    box.export(path)
    return path


def room() -> dict[str, Any]:
    """A layout of 4 x 4 m with one wall; the chest ``b`` stands turned by 90 degrees."""
    straight = np.eye(4)
    straight[:3, 3] = -0.8, -0.7, 0.0
    return {
        "floor": {"box_min": [-2.0, -2.0, -0.1], "box_max": [2.0, 2.0, 0.0]},
        "walls": [{"box_min": [-2.2, -2.0, 0.0], "box_max": [-2.0, 2.0, 2.0]}],
        "instances": [
            {"id": "a", "class": "chest", "mesh": "furniture/chest.ply", "T_room_from_object": straight.tolist()},
            {"id": "b", "class": "chest", "mesh": "furniture/chest.ply", "T_room_from_object": QUARTER_TURN},
        ],
    }


def write_room(folder: Path) -> Path:
    """``room.json`` and the chest beside it; the layout's path."""
    write_chest(folder / "chest.ply")
    (folder / "room.json").write_text(json.dumps(room()))
    return folder / "room.json"
