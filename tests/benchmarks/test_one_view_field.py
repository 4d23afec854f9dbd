"""The field behind one depth image: against a closed mesh's winding number, and against distances known by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from benchmarks.robust.depth_camera import DepthCamera, noisy
from benchmarks.robust.one_view_field import DepthImage, OneViewField
from benchmarks.simple_meshes import box, together
from regnf_core.fields.mesh import MeshField

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
