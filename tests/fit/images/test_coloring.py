"""The color of a finished geometry: what is learned, what is written, and how likeness to images is measured."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from regnf_core.fields.build import build_field
from regnf_core.fields.observation import has_color
from regnf_core.schema.safe_format import parse_description
from regnf_fit.images.coloring import (
    RadianceField,
    SurfaceColor,
    appearance_of,
    first_hits,
    fit_color,
    held_out_images,
    structural_similarity,
)
from regnf_fit.images.fit import stored_color
from regnf_fit.images.preparation import PixelRays, rays_of_pixels
from regnf_fit.images.trainer import least_sharpness, render_rays, render_weights, samples_about_depth
from regnf_fit.network import StartShape
from regnf_fit.options import ReconstructionOptions
from tests.fit.images import scenes
from tests.fit.images.test_reconstruct import SMALL

BOUNDS = torch.tensor([[-1.0] * 3, [1.0] * 3])
WHOLE = replace(SMALL, half_table=False)


def ball():
    """A field at its start, which is about a ball."""
    return RadianceField(WHOLE, StartShape(torch.zeros(3), 0.5), torch.Generator().manual_seed(0))


def pattern(points):
    """A color of each place, of detail that the ball's geometry knows nothing of."""
    return 0.5 + 0.4 * torch.sin(9.0 * points + torch.tensor([0.0, 1.0, 2.0]))


def rays_to(points):
    """One ray to each of these points of a ball round 0, from outside it, that sees the point's color."""
    count = len(points)
    directions = -torch.nn.functional.normalize(points, dim=1)
    zeros = torch.zeros(count)
    return PixelRays(
        points - 1.0 * directions,
        directions,
        zeros,
        zeros + 2.0,
        pattern(points),
        zeros,
        zeros > 0,
        zeros,
        zeros,
        torch.zeros(count, dtype=torch.int64),
    )


def on_the_ball(count, seed):
    generator = torch.Generator().manual_seed(seed)
    return 0.5 * torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)


def written(field, entry, colors):
    description = field.description(BOUNDS, None, {}) | {"color": entry}
    tensors = {name: torch.from_numpy(np.array(array)) for name, array in (field.tensors() | colors).items()}
    made = build_field(parse_description(description), tensors)
    assert has_color(made)
    return made


def test_a_pattern_on_a_ball_is_learned_and_the_geometry_stays():
    field = ball()
    before = {name: value.clone() for name, value in field.state_dict().items()}
    color = fit_color(field.requires_grad_(False), rays_to(on_the_ball(20_000, 1)), 3.46, seed=0)
    assert color is not None
    assert all(torch.equal(value, before[name]) for name, value in field.state_dict().items())
    made = written(field, *color.stored(False))
    others = rays_to(on_the_ball(500, 2))  # the start is a ball but roughly: where they meet it counts
    places = others.at(first_hits(field, others, 3.46).depths[:, None])[:, 0]
    error = made.color(places, others.directions) - others.colors
    assert -10.0 * float(error.square().mean().log10()) > 24.0


def test_rays_that_meet_nothing_give_no_color():
    rays = rays_to(on_the_ball(50, 1))
    assert fit_color(ball().requires_grad_(False), replace(rays, directions=-rays.directions), 3.46, seed=0) is None


def test_both_colors_are_read_back_as_they_were():
    """That which is learned with the geometry, and that of the finished geometry."""
    field, generator = ball().requires_grad_(False), torch.Generator().manual_seed(3)
    field.feature_bias.normal_(generator=generator)
    points = 2.0 * torch.rand(300, 3, generator=generator) - 1.0
    directions = torch.nn.functional.normalize(torch.randn(300, 3, generator=generator), dim=1)
    seen = appearance_of(field, points)
    normals = torch.nn.functional.normalize(seen.gradient, dim=1)
    features = field.feature(field.function().mlp.hidden(field.function().encode(points)))
    expected = field.color(points, directions, normals, features)
    found = written(field, *stored_color(field)).color(points, directions)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-5)
    color = SurfaceColor(WHOLE.hidden_width, 16, WHOLE.grid, generator).requires_grad_(False)
    color.table.normal_(generator=generator)
    found = written(field, *color.stored(False)).color(points, directions)
    torch.testing.assert_close(found, color.head()(seen, directions), rtol=0, atol=1e-5)


@pytest.mark.parametrize(("images", "count"), [(3, 0), (4, 1), (29, 1), (30, 2), (1000, 4)])
def test_a_few_images_are_held_out(images, count):
    chosen = held_out_images(images)
    assert len(set(chosen)) == len(chosen) == count
    assert all(0 <= number < images for number in chosen)


def test_structural_similarity_by_its_definition():
    generator = torch.Generator().manual_seed(4)
    one, other = torch.rand(2, 20, 24, 3, generator=generator, dtype=torch.float64)
    torch.testing.assert_close(structural_similarity(one, one), torch.ones(20, 24, dtype=torch.float64))
    weights = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    weights = np.outer(weights, weights) / weights.sum() ** 2
    values = []
    for channel in range(3):
        x, y = (picture[4:15, 6:17, channel].numpy() for picture in (one, other))
        mx, my = (weights * x).sum(), (weights * y).sum()
        vx, vy = (weights * (x - mx) ** 2).sum(), (weights * (y - my) ** 2).sum()
        both = (weights * (x - mx) * (y - my)).sum()
        c1, c2 = 0.01**2, 0.03**2
        values.append((2 * mx * my + c1) * (2 * both + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2)))
    assert float(structural_similarity(one, other)[9, 11]) == pytest.approx(np.mean(values), abs=1e-9)


# Opacity along rays by hand; the loss's gradient by the parameters against finite differences.


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
