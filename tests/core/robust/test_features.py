"""Feature matches: the pose among them whatever the scale and the frame, and nothing odd where there is nothing."""

from __future__ import annotations

import torch

from regnf_core.fields.composite import TransformedField
from regnf_core.geometry.metrics import displacement
from regnf_core.robust.model import model_object
from regnf_core.robust.search.distance_grid import feature_seeds
from regnf_core.robust.working_frame import Samples
from tests.core.analytic import AnalyticField, sphere, union
from tests.core.robust.shapes import random_pose


def blob() -> AnalyticField:
    """Balls of different sizes stuck together: curved differently everywhere. Flat faces would all look alike."""
    generator = torch.Generator().manual_seed(0)
    radii = [0.12, 0.16, 0.2, 0.24, 0.1, 0.14, 0.18]
    return union([sphere(r, (0.6 * torch.rand(3, generator=generator) - 0.3).tolist()) for r in radii])


def test_the_pose_is_among_the_seeds_at_any_scale() -> None:
    pose = random_pose(4, 37.0)
    one, two = model_object(TransformedField(blob(), pose.inverse())), model_object(blob())
    truth = two.frame.to_field().inverse() @ pose.inverse() @ one.frame.to_field()
    found = feature_seeds(one.samples, two.samples, 4, seed=1)
    assert displacement(found, truth, two.extremal_points).min() < 0.05
    torch.testing.assert_close(
        found.rotation @ found.rotation.mT, torch.eye(3).double().expand_as(found.rotation), atol=1e-9, rtol=0
    )
    again = feature_seeds(one.samples, two.samples, 4, seed=1)
    torch.testing.assert_close(again.rotation, found.rotation, rtol=0, atol=0)
    torch.testing.assert_close(again.scale, found.scale, rtol=0, atol=0)


def test_too_small_a_cloud_gives_no_seed() -> None:
    few = Samples(torch.randn(20, 3), torch.zeros(20), torch.tensor([[0.0, 0.0, 1.0]]).expand(20, 3))
    assert feature_seeds(few, model_object(blob()).samples, 2, seed=0).scale.numel() == 0
    assert feature_seeds(few, few, 0, seed=0).scale.numel() == 0
