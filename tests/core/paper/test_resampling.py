"""Algorithm 1: every accepted sample meets the paper's four conditions, checked by a slow reference."""

from __future__ import annotations

import torch

from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import ResamplingOptions
from regnf_core.paper.optimization import SampleSet, field_radius, resample
from tests.core.analytic import sphere

OPTIONS = ResamplingOptions()
IDENTITY = Sim3.identity()


def ball_samples(count: int) -> SampleSet:
    directions = torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    return SampleSet.of(sphere(0.3), 0.3 * torch.nn.functional.normalize(directions, dim=1))


def test_accepted_samples_meet_all_four_conditions() -> None:
    old = ball_samples(300)
    own, other = sphere(0.3), sphere(0.305, (0.004, 0.0, 0.0))
    new = resample(old, own, other, IDENTITY, OPTIONS, torch.Generator().manual_seed(1))
    assert torch.equal(new.points[:300], old.points)  # nothing old is lost while there is room
    fresh = new.points[300:]
    assert len(fresh) > 20
    rho = 0.05 * field_radius(own)
    assert rho == 0.05
    for x in fresh:
        s_own = float(x.norm()) - 0.3
        s_other = float((x - torch.tensor([0.004, 0.0, 0.0])).norm()) - 0.305
        assert abs(s_own) <= 0.01 + 1e-6
        assert abs(s_other) <= 0.02 + 1e-6
        assert abs(s_own - s_other) <= 0.02 + 1e-6
        distances = (old.points - x).norm(dim=1)
        assert float(distances.min()) >= rho / 10 - 1e-6
        assert float((old.points - x).abs().amax(1).min()) <= rho + 1e-6  # shaken from one of the old ones
    torch.testing.assert_close(new.own_distance, own.signed_distance(new.points))


def test_nothing_is_accepted_where_the_other_surface_is_not() -> None:
    old = ball_samples(200)
    far = resample(old, sphere(0.3), sphere(0.3, (0.9, 0.0, 0.0)), IDENTITY, OPTIONS, torch.Generator().manual_seed(1))
    assert torch.equal(far.points, old.points)


def test_the_transform_carries_samples_to_the_other_field() -> None:
    old = ball_samples(200)
    T_other_own = Sim3.from_quaternion(2.0, [0, 0, 0, 1], [0.5, 0.0, 0.0])
    grown = resample(old, sphere(0.3), sphere(0.6, (0.5, 0, 0)), T_other_own, OPTIONS, torch.Generator().manual_seed(1))
    assert len(grown.points) > 210


def test_the_number_of_samples_stays_bounded() -> None:
    few = ResamplingOptions(max_samples=250)
    new = resample(ball_samples(240), sphere(0.3), sphere(0.3), IDENTITY, few, torch.Generator().manual_seed(1))
    assert len(new.points) == 250


def test_the_same_seed_gives_the_same_samples() -> None:
    one, two, other = (
        resample(ball_samples(200), sphere(0.3), sphere(0.3), IDENTITY, OPTIONS, torch.Generator().manual_seed(seed))
        for seed in (5, 5, 6)
    )
    assert torch.equal(one.points, two.points)
    assert not torch.equal(one.points[200:], other.points[200:])
