"""The display meshes of the made-up registration's fields: the room with its chair, and the chair by itself."""

from __future__ import annotations

import numpy as np
import trimesh

from regnf_core.viewing.field_views import mesh_file
from tests.ui.synthetic import CHAIR_IN_SCENE, LIBRARY_FROM_CHAIR, Array, chair_boxes

_ROOM: list[tuple[list[float], list[float]]] = [
    ([-1.6, -1.6, -0.05], [1.6, 1.6, 0.0]),
    ([-1.65, -1.6, 0.0], [-1.6, 1.6, 1.5]),
    ([-1.6, -1.65, 0.0], [1.6, -1.6, 1.5]),
    ([-1.2, -1.1, 0.35], [-0.4, -0.6, 0.4]),
]


def scene_mesh() -> bytes:
    return _glb([*(_box(*corners) for corners in _ROOM), *_chair(CHAIR_IN_SCENE)])


def object_mesh() -> bytes:
    return _glb(_chair(LIBRARY_FROM_CHAIR))


def _chair(placed: Array) -> list[trimesh.Trimesh]:
    boxes = [_box(*corners) for corners in chair_boxes()]
    for box in boxes:
        box.apply_transform(placed)
    return boxes


def _box(low: list[float], high: list[float]) -> trimesh.Trimesh:
    made: trimesh.Trimesh = trimesh.creation.box(np.subtract(high, low))
    made.apply_translation(np.add(low, high) / 2)
    return made


def _glb(parts: list[trimesh.Trimesh]) -> bytes:
    mesh = trimesh.util.concatenate(parts)
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh_file(mesh.vertices, mesh.faces)
