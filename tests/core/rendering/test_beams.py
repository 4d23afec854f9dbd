"""Bundles of rays: nothing is passed over, and few evaluations are spent. Truth: dense samples of exact distances."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from regnf_core import Camera, RenderOptions, render
from regnf_core.fields.observation import CountingField, SdfField
from regnf_core.rendering.render import free_start
from regnf_core.rendering.tracing import DistanceGrid, Region, Start
from regnf_core.surface.sphere_tracing import Rays
from tests.core.analytic import AnalyticField, boxes, sphere

SIZE = (64, 48)
ROD = ([0.11, -0.4, 0.0], [0.122, 0.4, 0.012])
"""Thinner than a pixel of the bundles, and than a cell of the grid."""
FIELDS = {
    "ball": sphere(0.35, [0.05, 0.0, 0.02]),
    "rod before a slab": boxes([ROD, ([-0.7, -0.9, -0.9], [-0.2, 0.9, 0.9])]),
}
CAMERAS = {
    "within": Camera.look_at([0.45, -0.1, 0.1], [-0.2, 0.0, 0.0], SIZE, 60.0),
    "outside": Camera.look_at([1.9, -0.7, 0.6], [0.0, 0.0, 0.0], SIZE, 40.0),
}


def begun(field: SdfField, camera: Camera, margin: float = 0.0) -> tuple[Region, Rays, Start]:
    pixels = torch.arange(SIZE[0] * SIZE[1])
    rays, _ = camera.rays(pixels)
    region = Region.along(rays, field, DistanceGrid.of(field), 4e-4)
    return region, rays, free_start(region, rays, pixels // SIZE[0], pixels % SIZE[0], margin)


def sampled(field: SdfField, region: Region, rays: Rays, lengths: Tensor) -> Tensor:
    """(N, K) distances between each ray's entry and its length (N,)."""
    share = torch.linspace(0.0, 1.0, 400)
    t = region.entry[:, None] + share * (lengths - region.entry)[:, None]
    points = rays.origins[:, None] + t[..., None] * rays.directions[:, None]
    return field.signed_distance(points.view(-1, 3)).view(len(lengths), -1)


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
@pytest.mark.parametrize("field", FIELDS.values(), ids=FIELDS.keys())
def test_no_ray_is_moved_past_a_surface(field: AnalyticField, camera: Camera) -> None:
    region, rays, start = begun(field, camera)
    ahead = start.free & (region.exit > region.entry)
    assert bool(ahead.any())
    passed = sampled(field, region, rays, torch.minimum(start.length, region.exit))[ahead]
    assert float(passed.min()) > 0.0
    assert bool((start.length >= region.entry).all())


def test_a_margin_is_kept() -> None:
    field, margin = FIELDS["ball"], 0.01
    _, rays, start = begun(field, CAMERAS["within"], margin)
    ends = rays.origins + start.length[:, None] * rays.directions
    assert float(field.signed_distance(ends[start.free]).min()) > margin


def test_a_pixel_takes_few_evaluations() -> None:
    field = CountingField(sphere(0.35, [0.05, 0.0, 0.02]))
    DistanceGrid.of(field)
    prepared = field.evaluations
    render(field, CAMERAS["within"], RenderOptions())
    asked = field.evaluations - 2 * prepared
    assert asked / (SIZE[0] * SIZE[1]) < 6.0
