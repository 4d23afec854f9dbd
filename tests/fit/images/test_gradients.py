"""Opacity along rays by hand; the loss's gradient by the parameters against finite differences."""

from __future__ import annotations

import math

import numpy as np
import torch

from regnf_fit.images.coloring import RadianceField
from regnf_fit.images.preparation import rays_of_pixels
from regnf_fit.images.trainer import least_sharpness, render_rays, render_weights, samples_about_depth
from regnf_fit.network import StartShape
from regnf_fit.options import ReconstructionOptions
from tests.fit.images import scenes


def test_weights_agree_with_the_equation_point_by_point():
    rng = np.random.default_rng(0)
    distances = rng.normal(scale=0.1, size=(20, 12))
    sharpness = 40.0
    weights, rest = render_weights(torch.from_numpy(distances), sharpness)
    for ray in range(20):
        passed = 1.0
        for i in range(11):
            phi, following = (1.0 / (1.0 + math.exp(-sharpness * f)) for f in distances[ray, i : i + 2])
            alpha = max((phi - following) / phi, 0.0)
            assert math.isclose(float(weights[ray, i]), passed * alpha, rel_tol=1e-9, abs_tol=1e-12)
            passed *= 1.0 - alpha
        assert math.isclose(float(rest[ray]), passed, rel_tol=1e-9)


def test_a_surface_hides_what_lies_behind_it():
    depth = torch.linspace(0.0, 4.0, 400)
    distances = torch.minimum((depth - 1.0).abs(), (depth - 3.0).abs())[None] - 0.3
    weights, _ = render_weights(distances, 200.0)
    first = weights[0, depth[:-1] < 2.0]
    assert first.sum() > 0.999
    assert abs(float((weights[0] * (depth[1:] + depth[:-1]) / 2.0).sum()) - 0.7) < 0.02


def test_the_least_sharpness_rises_from_start_to_end():
    values = [least_sharpness(share, 2.0) for share in (0.0, 0.25, 0.5, 1.0)]
    assert values == sorted(values)
    assert math.isclose(values[0], 10.0)
    assert math.isclose(values[-1], 200.0)


OPTIONS = ReconstructionOptions(hidden_width=8, feature_width=4)


def loss_and_parameter():
    images = scenes.images(count=2, height=12, width=16)
    rays = rays_of_pixels(images, np.flatnonzero(images.depths.ravel() > 0.0)[:12], None)
    generator = torch.Generator().manual_seed(0)
    field = RadianceField(OPTIONS, StartShape(torch.zeros(3), 0.3, False), generator)
    depths = samples_about_depth(rays, torch.full((len(rays),), 0.05), generator)

    def loss():
        rendered = render_rays(field, rays, depths, torch.tensor(15.0), torch.zeros(3))
        points = rays.at(depths).flatten(0, 1)
        _, gradient = field.function().value_and_gradient(points)
        eikonal = (gradient.norm(dim=1) - 1.0).square().mean()
        return rendered.opacity.mean() + rendered.depths.mean() + 0.1 * eikonal

    return field, loss


def test_the_loss_falls_as_its_gradient_says():
    field, loss = loss_and_parameter()
    loss().backward()
    for parameter in (field.table, field.weights[0], field.weights[1], field.biases[2]):
        direction = parameter.grad / parameter.grad.norm()
        expected = float(parameter.grad.norm())
        step = 2e-3 if parameter is not field.table else 1e-3
        with torch.no_grad():
            parameter.add_(step * direction)
            above = float(loss())
            parameter.sub_(2.0 * step * direction)
            below = float(loss())
            parameter.add_(step * direction)
        np.testing.assert_allclose((above - below) / (2.0 * step), expected, rtol=0.03)


def test_a_geometry_that_does_not_learn_is_rendered_alike_and_has_no_gradient():
    field, _ = loss_and_parameter()
    images = scenes.images(count=2, height=12, width=16)
    rays = rays_of_pixels(images, np.flatnonzero(images.depths.ravel() > 0.0)[:12], None)
    depths = samples_about_depth(rays, torch.full((len(rays),), 0.05), torch.Generator().manual_seed(1))
    sharpness = 15.0 * field.log_sharpness.exp()
    learning, still = (render_rays(field, rays, depths, sharpness, torch.zeros(3), one) for one in (True, False))
    for name in ("colors", "depths", "opacity"):
        torch.testing.assert_close(getattr(still, name), getattr(learning, name))
    (still.colors.mean() + still.depths.mean()).backward()
    assert all(parameter.grad is None for parameter in (field.table, *field.weights, *field.biases))
    for parameter in (field.log_sharpness, field.feature_weight, *field.color_weights):
        assert float(parameter.grad.abs().max()) > 0.0
