"""The scale of what was seen from one side: neither the units of the residuals nor what was hidden makes it larger."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from regnf_core.geometry.sim3 import Sim3
from regnf_core.robust.constants import REFINEMENT
from regnf_core.robust.refine.levenberg_marquardt import minimize
from regnf_core.robust.refine.loss import normal_equations, observed_weight
from regnf_core.robust.residuals import Residuals, SurfacePair
from regnf_core.robust.working_frame import Samples
from tests.core.robust.shapes import random_pose

D = torch.float64
NOISE = 0.02
CAP = 0.6
"""Height of the seen cap of a sphere of radius 1."""


class Ball:
    """The distance to a sphere of radius 1, and its gradient."""

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        length = points.norm(dim=-1)
        return length - 1.0, points / length[:, None]


def cap(count: int, seed: int, noise: float) -> Samples:
    """Samples of the cap about the z axis, off the sphere by the noise; they are taken to lie on the surface."""
    generator = torch.Generator().manual_seed(seed)
    z = 1.0 - CAP * torch.rand(count, generator=generator, dtype=D)
    turn = 2 * torch.pi * torch.rand(count, generator=generator, dtype=D)
    ring = (1 - z**2).sqrt()
    normals = torch.stack([ring * turn.cos(), ring * turn.sin(), z], 1)
    off = noise * torch.randn(count, generator=generator, dtype=D)
    return Samples(normals * (1 + off)[:, None], torch.zeros(count, dtype=D), normals)


def closed_form_radius(points: Tensor) -> float:
    """The sphere through points (N, 3) with the least squares of distances in their own frame: Gauss-Newton on center
    and radius, nothing of the engine's."""
    center, radius = torch.zeros(3, dtype=D), torch.ones((), dtype=D)
    for _ in range(50):
        arm = points - center
        length = arm.norm(dim=1)
        J = torch.cat([-arm / length[:, None], -torch.ones(len(points), 1, dtype=D)], 1)
        step = torch.linalg.lstsq(J, -(length - radius)[:, None]).solution[:, 0]
        center, radius = center + step[:3], radius + step[3]
    return float(radius)


def _silent() -> Samples:
    """A sample of the object that faces the other way than all surface does, and so weighs nothing."""
    top = torch.tensor([[0.0, 0.0, 1.0]], dtype=D)
    return Samples(top, torch.zeros(1, dtype=D), -top)


def test_the_scale_is_that_of_least_squares_in_the_scene() -> None:
    """One direction alone, where least squares can be solved by another route: the sphere through noisy points."""
    radii, found = [], []
    for seed in range(20):
        scene = cap(400, seed, NOISE)
        T = minimize(SurfacePair(Ball(), Ball(), scene, _silent()), Sim3.identity()[None], [5.0] * 60).T
        radii.append(closed_form_radius(scene.points))
        found.append(float(1.0 / T.scale))
    torch.testing.assert_close(torch.tensor(found), torch.tensor(radii), rtol=2e-3, atol=0.0)


@pytest.mark.parametrize("frame", [0, 1])
def test_the_frames_and_their_units_do_not_matter(frame: int) -> None:
    """A scene in other units, and turned, leads to the same size of the object in it."""
    scene, turned = cap(400, 5, NOISE), random_pose(frame, 7.0)
    S = Sim3(turned.scale, turned.rotation, torch.zeros(3, dtype=D))
    objects = cap(200, 6, 0.0)

    class Moved:
        def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
            value, gradient = Ball().value_and_gradient(S.inverse().apply(points))
            return S.scale * value, gradient @ S.rotation.T

    moved = Samples(S.apply(scene.points), scene.values, scene.normals @ S.rotation.T)
    widths = [0.1] * 30
    here = minimize(SurfacePair(Ball(), Ball(), scene, objects), Sim3.identity()[None], widths).T
    there = minimize(SurfacePair(Moved(), Ball(), moved, objects), S.inverse()[None], widths).T
    assert float(there.scale * S.scale) == pytest.approx(float(here.scale), rel=1e-6)


def partly_observed() -> Residuals:
    """Of seven samples, three of them the scene's; one of the four of the object was observed."""
    generator = torch.Generator().manual_seed(0)
    values = 0.02 * torch.randn(1, 7, generator=generator, dtype=D)
    J = torch.randn(1, 7, 7, generator=generator, dtype=D)
    unobserved = torch.tensor([[False, False, True, False, True, True, True]])
    return Residuals(values, J, torch.ones(1, 7, dtype=D), 3, unobserved)


def test_observed_samples_weigh_as_if_all_had_been_observed() -> None:
    """One of four was: what it adds to J^T W J, written out once more, counts four times."""
    r, width = partly_observed(), 0.03
    weight = observed_weight(r)
    assert weight is not None
    assert weight.tolist() == [[4.0]]
    weighted, _ = normal_equations(r, width, weight=weight)
    plain, _ = normal_equations(r, width)
    J, value = r.jacobian[0, 3], r.values[0, 3]
    one = J[:, None] * J[None] / (1 + (value / width) ** 2) ** 2 / 4
    torch.testing.assert_close((weighted - plain)[0], 3 * one)


def test_where_next_to_nothing_was_observed_the_weight_is_bounded() -> None:
    r = partly_observed()
    hidden = Residuals(r.values, r.jacobian, r.cosines, 3, torch.ones(1, 7, dtype=torch.bool))
    assert observed_weight(hidden).tolist() == [[1.0 / REFINEMENT.min_observed_share]]  # type: ignore[union-attr]
    everything = Residuals(r.values, r.jacobian, r.cosines, 3)
    assert observed_weight(everything) is None
