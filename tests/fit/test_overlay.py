"""The overlay: the object's edges where they lie in the image, whole, hidden, of other poses, and outside."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh

from regnf_core.document import CameraView
from regnf_core.geometry.sim3 import Sim3
from regnf_core.in_memory import from_mesh
from regnf_data.recordings.camera import camera_of
from regnf_data.recordings.recording import Frame
from regnf_fit.images.overlay import inverse_depths, object_mesh, overlay_picture

BOX = trimesh.creation.box((200.0, 120.0, 80.0))  # millimeters
CAPTION, ZOOM = 52, 540 / 240


def pose(x: float = 0.0, z: float = 1.0) -> Sim3:
    matrix = np.diag([0.001, 0.001, 0.001, 1.0])
    matrix[:3, 3] = x, 0.0, z
    return Sim3.from_matrix(matrix.tolist())


def picture(found: Sim3, depth: float = 1.0, other: Sim3 | None = None, color: bool = True) -> np.ndarray:
    world = np.eye(4)
    world[:3, 3] = 3.0, -2.0, 1.0
    camera = Sim3.from_matrix(world.tolist())
    image = np.full((240, 320, 3), 128, np.uint8) if color else None
    frame = Frame("7.png", np.full((240, 320), depth, np.float32), camera_of(300, 300, 160, 120), world, image)
    alternatives = [] if other is None else [SimpleNamespace(T_scene_object=camera @ other)]
    result = SimpleNamespace(
        camera=CameraView("7.png", camera, 0.001),
        T_scene_object=camera @ found,
        alternatives=alternatives,
        center_object=torch.zeros(3, dtype=torch.float64),
        verdict="registered",
        probability=0.9,
        level="default",
    )
    sheet = overlay_picture(result, frame, BOX.vertices, BOX.faces)  # type: ignore[arg-type]
    return np.asarray(sheet, dtype=np.int64)[CAPTION:]


def orange(image: np.ndarray) -> np.ndarray:
    return image[..., 0] - image[..., 2] > 90


def test_the_outline_lies_where_the_object_is_seen() -> None:
    shown = picture(pose())
    assert shown.shape == (540, 720 + 540, 3)
    rows, columns = np.nonzero(orange(shown[:, :720]))
    half = 300 * np.array([0.1, 0.06]) / (1.0 - 0.04) * ZOOM  # of the near face
    found = np.array([np.ptp(columns), np.ptp(rows)]) / 2.0
    assert np.abs(found - half).max() < 3.0
    assert orange(shown[:, 720:]).sum() > orange(shown[:, :720]).sum()  # the close-up is larger


def test_what_is_hidden_is_weaker_and_other_poses_are_blue() -> None:
    assert orange(picture(pose())[:, :720]).any()
    assert not orange(picture(pose(), depth=0.5)[:, :720]).any()
    blue = [picture(pose(), other=other)[:, :720, 2].max() for other in (None, pose(0.05))]
    assert blue[1] > blue[0] + 40


@pytest.mark.parametrize("color", [True, False])
@pytest.mark.parametrize("found", [pose(5.0), pose(z=-1.0), pose(z=0.0)], ids=["beside", "behind", "around"])
def test_an_object_outside_the_image_leaves_it_bare(found: Sim3, color: bool) -> None:
    assert not orange(picture(found, color=color)[:, :720]).any()


def test_the_nearest_triangle_counts() -> None:
    corners = np.array([[[-1.0, -1.0, 2.0], [1.0, -1.0, 2.0], [0.0, 2.0, 2.0]]])
    K = np.array([[20.0, 0.0, 20.0], [0.0, 20.0, 20.0], [0.0, 0.0, 1.0]])
    points = np.concatenate([corners, corners * 2.0, corners * 0.5]).reshape(-1, 3)
    found = inverse_depths(points, np.arange(9).reshape(3, 3), K, (40, 40))
    assert found[20, 20] == pytest.approx(1.0)
    assert found[0, 0] == 0.0


def test_an_object_without_triangles_has_those_of_its_surface() -> None:
    field = from_mesh(BOX.vertices, BOX.faces)
    assert len(object_mesh(field)[1]) == 12

    class Distances:
        bounds, device = field.bounds, field.device
        signed_distance = staticmethod(field.signed_distance)
        signed_distance_and_gradient = staticmethod(field.signed_distance_and_gradient)

    vertices, faces = object_mesh(Distances())  # type: ignore[arg-type]
    assert np.abs(np.ptp(vertices, axis=0) - (200.0, 120.0, 80.0)).max() < 3.0
    assert len(faces) > 1000
