"""The covariance against what errors of known kind really do to the minimum."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.stats import chi2
from torch import Tensor

from regnf_core.geometry.sim3 import Sim3
from regnf_core.robust.residuals import Residuals, SurfacePair, residuals
from regnf_core.robust.sampling import sample_object_surface
from regnf_core.robust.verdict.covariance import covariance, in_object_units
from regnf_core.robust.working_frame import WorkingFrame
from tests.core.analytic import chair
from tests.core.robust.shapes import random_pose

WIDTH = torch.tensor([[0.5]])  # far wider than the errors: the cost is quadratic


def at_the_truth(count: int) -> tuple[Residuals, Tensor]:
    """Residuals (all 0) and Jacobians of the chair laid onto itself, and the places of the samples."""
    found = sample_object_surface(chair(), 2000, torch.Generator().manual_seed(0))
    one = found.samples[torch.randperm(len(found.samples), generator=torch.Generator().manual_seed(1))[:count]]
    two = found.samples[torch.randperm(len(found.samples), generator=torch.Generator().manual_seed(2))[:count]]
    identity = Sim3.identity()[None]
    r = residuals(SurfacePair(found.field, found.field, one, two), identity)
    return r, torch.cat([one.points, two.points]).double()


def disturbed(r: Residuals, errors: Tensor) -> tuple[Residuals, Tensor]:
    """What least squares makes of errors (N + M,): the residuals left, and the pose error (7,) made."""
    n = r.scene_count
    total = r.values.shape[1]
    share = torch.cat([torch.full((n,), 1.0 / n), torch.full((total - n,), 1.0 / (total - n))]).double()
    J = r.jacobian[0].double()
    step = -torch.linalg.solve((J * share[:, None]).T @ J, (J * share[:, None]).T @ errors)
    left = errors + J @ step
    return Residuals(left[None].float(), r.jacobian, r.cosines, n), step


@pytest.mark.parametrize("length", [0.0, 0.05, 0.15, 0.4])
def test_errors_of_any_length_lie_inside_the_ellipsoid(length: float) -> None:
    """Smooth errors with a tenth of their size in roughness; a length of 0 is roughness alone."""
    r, places = at_the_truth(250)
    n = r.scene_count
    sign = torch.cat([torch.ones(n), -torch.ones(r.values.shape[1] - n)]).double()
    K = torch.eye(len(places)).double()
    if length > 0:
        K = 0.99 * torch.exp(-0.5 * (torch.cdist(places, places) / length).square()) + 0.01 * K
    factor = torch.linalg.cholesky(K)
    generator = torch.Generator().manual_seed(5)
    squares = []
    for _ in range(60):
        errors = 0.002 * sign * (factor @ torch.randn(len(places), generator=generator, dtype=torch.float64))
        left, step = disturbed(r, errors)
        cov = covariance(left, WIDTH[0], places)
        squares.append(float(step @ torch.linalg.solve(cov, step)))
    inside = sum(square <= chi2.ppf(0.95, 7) for square in squares) / len(squares)
    middle = sorted(squares)[len(squares) // 2] / chi2.median(7)
    assert inside >= 0.85
    assert 0.3 < middle < 2.0


def test_white_errors_give_the_textbook_covariance() -> None:
    r, places = at_the_truth(120)  # all of them are looked at
    generator = torch.Generator().manual_seed(6)
    sigma = 0.002
    errors = sigma * torch.randn(len(places), generator=generator, dtype=torch.float64)
    left, _ = disturbed(r, errors)
    found = covariance(left, WIDTH[0], places)
    J = r.jacobian[0].double()
    expected = sigma**2 * torch.linalg.inv(J.T @ J)
    ratio = (found.diagonal() / expected.diagonal()).sqrt()
    assert ratio.min() > 0.7
    assert ratio.max() < 1.6


def test_it_is_a_covariance_even_without_any_error_or_support() -> None:
    r, places = at_the_truth(100)
    for values in (r.values, torch.full_like(r.values, 10.0)):
        cov = covariance(Residuals(values, r.jacobian, r.cosines, r.scene_count), WIDTH[0], places)
        torch.testing.assert_close(cov, cov.T)
        assert (torch.linalg.eigvalsh(cov) > 0).all()


def test_units_and_frames_by_moving_a_point() -> None:
    """The same small perturbation, in working frames and in the fields' own, moves points alike."""
    scene = WorkingFrame(torch.tensor([0.4, -2.0, 1.0]).double(), 3.0)
    obj = WorkingFrame(torch.tensor([-0.3, 0.1, 5.0]).double(), 0.2)
    T_work = random_pose(7, 0.8)
    step = 1e-6 * torch.tensor([0.5, -0.3, 0.8, 0.2, 0.4, -0.1, 0.6], dtype=torch.float64)
    L = in_object_units(torch.diag(torch.ones(7)).double(), T_work, scene, obj)
    # Column by column: the covariance of a rank one perturbation is its outer product.
    outer = in_object_units(torch.outer(step, step), T_work, scene, obj)
    own = outer[:, 6] / math.sqrt(float(outer[6, 6]))
    assert L.shape == (7, 7)

    def in_fields(T: Sim3) -> Sim3:
        return obj.to_field() @ T @ scene.to_field().inverse()

    def moved(T: Sim3, by: Tensor) -> Sim3:
        batch = T[None].perturb(by[None])
        return Sim3(batch.scale[0], batch.rotation[0], batch.translation[0])

    points = torch.randn(5, 3, generator=torch.Generator().manual_seed(8), dtype=torch.float64)
    expected = in_fields(moved(T_work, step)).apply(points)
    found = moved(in_fields(T_work), own * torch.sign(own[6] * step[6])).apply(points)
    still = in_fields(T_work).apply(points)
    torch.testing.assert_close(found - still, expected - still, rtol=1e-4, atol=1e-12)
