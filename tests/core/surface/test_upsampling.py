"""New points between old ones lie on the surface and where they may."""

from __future__ import annotations

import torch

from regnf_core.geometry.box import OrientedBox
from regnf_core.options import SamplingOptions
from regnf_core.paper.sampling import sample_scene
from regnf_core.surface.result_clouds import upsample
from tests.core.analytic import sphere

OPTIONS = SamplingOptions(pixel_stride=16)
BALL_BOX = OrientedBox.from_corners([-0.3, -0.3, -0.3], [0.3, 0.3, 0.3])


def test_upsampled_points_lie_on_the_surface_and_inside() -> None:
    ball = sphere(0.25)
    samples = sample_scene(ball, BALL_BOX, OPTIONS)
    upper = samples.points[:, 2] > 0
    half = samples[upper]
    dense = upsample(ball, half, 3000, torch.Generator().manual_seed(0), lambda points: points[:, 2] > 0)
    assert 2000 < len(dense.points) <= 3000
    assert float((dense.points.norm(dim=1) - 0.25).abs().max()) < 1e-3
    assert bool((dense.points[:, 2] > 0).all())
    torch.testing.assert_close(dense.normals.norm(dim=1), torch.ones(len(dense.normals)))
