"""The field behind one depth image: against a closed mesh's winding number, and against distances known by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from benchmarks.robust.depth_camera import DepthCamera, noisy
from benchmarks.robust.one_view_field import DepthImage, OneViewField
from benchmarks.simple_meshes import box, together
from regnf_core.fields.mesh import MeshField
from regnf_core.library import register
from tests.core.analytic import chair, chair_pose
from tests.core.robust.shapes import ROBUST, detection, placement_error

EYE = np.array([0.1, -2.0, 1.2])
BOUNDS = torch.tensor([[-2.0, -2.0, -0.1], [2.0, 2.0, 2.0]], dtype=torch.float64)


@pytest.fixture(scope="module")
def image() -> DepthImage:
    """A cube of edge 0.6 on a floor, seen from in front and above."""
    scene = together(box((-2.0, -2.5, -0.1), (2.0, 2.0, 0.0)), box((-0.3, -0.3, 0.0), (0.3, 0.3, 0.6)))
    camera = DepthCamera(scene.vertices.astype(np.float32), scene.faces.astype(np.int32), far=6.0)
    return camera.look(EYE, np.array([0.0, 0.0, 0.3]), pixels=121)


def test_visible_faces_lie_at_their_distance_and_shadows_are_solid(image: DepthImage) -> None:
    field = OneViewField(image, BOUNDS)
    points = torch.tensor(
        [
            [0.0, -0.4, 0.3],  # 0.1 before the front face
            [0.0, -0.25, 0.3],  # 0.05 within the cube
            [0.0, 0.0, 0.65],  # 0.05 above it
            [0.8, -0.2, 0.05],  # 0.05 above the floor beside it
            [0.0, 0.5, 0.15],  # behind it, in its shadow
            [0.0, -0.2, -0.3],  # below the floor
            [0.0, -3.0, 1.2],  # behind the camera
        ]
    )
    value, gradient = field.signed_distance_and_gradient(points)
    assert torch.allclose(value[:4], torch.tensor([0.1, -0.05, 0.05, 0.05]), atol=2e-3)
    assert (value[4:] < -0.05).all()
    assert torch.allclose(gradient[0], torch.tensor([0.0, -1.0, 0.0]), atol=0.05)
    assert torch.allclose(gradient[3], torch.tensor([0.0, 0.0, 1.0]), atol=0.05)


def test_the_sign_agrees_with_the_winding_number_of_the_closed_mesh(image: DepthImage) -> None:
    rough = noisy(image, 0.02, seed=1)
    field = OneViewField(rough, BOUNDS)
    free = MeshField(field.vertices, field.faces)  # closed: the inside is what the camera sees through
    points = torch.rand(3000, 3, generator=torch.Generator().manual_seed(0)) * 4.0 - torch.tensor([2.0, 2.5, 0.5])
    value, exact = field.signed_distance(points), free.signed_distance(points)
    assert 0.05 < float((value > 0).float().mean()) < 0.95
    assert torch.allclose(value, -exact, atol=1e-5)


# A chair of which one depth image is all that was ever seen is found, and its shadow told from it.

PARTS = (
    ((-0.24, -0.25, -0.04), (0.24, 0.25, 0.02)), ((-0.24, 0.19, 0.02), (0.24, 0.25, 0.42)),
    ((-0.24, -0.25, -0.40), (-0.18, -0.19, -0.04)), ((0.18, -0.25, -0.40), (0.24, -0.19, -0.04)),
    ((-0.24, 0.19, -0.40), (-0.18, 0.25, -0.04)), ((0.18, 0.19, -0.40), (0.24, 0.25, -0.04)),
    ((0.20, -0.25, 0.16), (0.30, 0.19, 0.22)), ((0.20, -0.25, 0.02), (0.26, -0.19, 0.16)),
)  # fmt: skip
"""The boxes of tests.core.analytic.chair."""


@pytest.mark.parametrize("position", [(0.9, -0.9, 0.85)])
def test_it_is_found(position: tuple[float, float, float]) -> None:
    placed = together(*(box(low, high) for low, high in PARTS)).transformed(chair_pose().inverse().matrix().numpy())
    room = together(placed, box((-1.0, -1.0, -0.06), (1.0, 1.0, 0.0)), box((-1.0, 0.94, 0.0), (1.0, 1.0, 0.9)))
    camera = DepthCamera(room.vertices.astype(np.float32), room.faces.astype(np.int32), far=4.0)
    image = camera.look(np.array(position), detection().center.numpy(), pixels=200)
    scene = OneViewField(image, torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]).double())
    result = register(scene, chair(), detection(), ROBUST)
    assert result.verdict == "registered"
    assert result.metrics["probability"] > 0.9, "what was hidden does not speak against it"
    assert placement_error(result, chair_pose()) < 0.02
    assert result.metrics["occlusion_boundary_share_scene"] > 0.2
    assert result.metrics["occluded_share_object"] > 0.15
