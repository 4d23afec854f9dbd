"""A chair is found in the mesh of a furnished room whose faces look inward, as a scanner leaves them."""

from __future__ import annotations

import json

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray

from regnf_core.geometry.box import OrientedBox
from regnf_core.importing.meshes import read_mesh
from regnf_core.library import register
from tests.core.importing.meshes.mesh_files import field_of
from tests.core.importing.meshes.test_facing import converted, parts, together, without
from tests.devdata import dev_data


def furniture(name: str, T: NDArray[np.float64] | None = None) -> trimesh.Trimesh:
    found = read_mesh("glb", memoryview(dev_data("furniture", name).read_bytes()))
    matrix = np.eye(4) if T is None else T
    return trimesh.Trimesh(found.vertices @ matrix[:3, :3].T + matrix[:3, 3], found.faces, process=False)


def test_a_chair_in_a_scanned_room_without_a_wall_and_the_ceiling() -> None:
    layout = json.loads(dev_data("rooms", "mix-room.json").read_text())
    things = {each["id"]: each for each in layout["instances"] if each["id"] in ("fc", "dc", "t")}
    poses = {name: np.array(each["T_room_from_object"]) for name, each in things.items()}
    shell = parts([[-2.4, -2.4, 0.0], [2.6, 2.6, 2.4]])
    shell.invert()
    shell = without(shell, lambda c: (c[:, 2] > 2.39) | (c[:, 0] > 2.59))
    meshes = [furniture(each["mesh"].rpartition("/")[2], poses[name]) for name, each in things.items()]
    scene = converted(together(shell, *meshes), **{"as": "scene"})
    chair = converted(furniture(things["dc"]["mesh"].rpartition("/")[2]), **{"as": "object"})
    low, high = (np.array(things["dc"][corner]) for corner in ("aabb_min", "aabb_max"))
    box = OrientedBox(torch.tensor((low + high) / 2), torch.tensor(high - low), torch.eye(3, dtype=torch.float64))
    found = register(field_of(scene), field_of(chair), box, seed=0, clouds=False)
    assert found.T_object_scene is not None
    matrix, truth = found.T_object_scene.matrix().numpy(), np.linalg.inv(poses["dc"])
    corners = low + (high - low) * np.random.default_rng(0).random((50, 3))
    apart = np.linalg.norm((matrix - truth)[:3, :3] @ corners.T + (matrix - truth)[:3, 3:], axis=0)
    assert apart.max() < 0.01 * np.linalg.norm(high - low)
