"""Color, depth and opacity of rays, rendered through the field."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.fields.neus_facto_function import NeusFactoFunction
from regnf_fit.images.network import RadianceField
from regnf_fit.images.opacity import render_weights
from regnf_fit.images.rays import PixelRays

_COLORED_SECTIONS = 3
"""On each ray the color is evaluated in so many sections, those that count most."""
_FREE_SAMPLES = 5
_BAND_SAMPLES = 9
_EVEN_SAMPLES = 24


@dataclass(frozen=True)
class Rendered:
    """Of R rays: colors (R, 3) in [0, 1], as they lie before ``background`` · depths (R,) along the camera's axis,
    of what is opaque · opacity (R,) in [0, 1]."""

    colors: Tensor
    depths: Tensor
    opacity: Tensor


def render_rays(
    field: RadianceField,
    rays: PixelRays,
    depths: Tensor,
    sharpness: Tensor,
    background: Tensor,
    geometry_learns: bool = True,
) -> Rendered:
    """Render rays through samples at ``depths`` (R, S), ascending; background: (3,) the color behind everything.

    Differentiable by the field's parameters. Normals given to the color's network are not differentiated: the
    geometry learns from the opacity. geometry_learns: False leaves all of it out, but for the sharpness.
    """
    function = field.function()
    learning = geometry_learns and torch.is_grad_enabled()
    with torch.set_grad_enabled(learning):
        distances = function.value(rays.at(depths).flatten(0, 1)).view_as(depths)
    weights, rest = render_weights(distances, sharpness)
    middles = (depths[:, 1:] + depths[:, :-1]) / 2.0
    opacity = 1.0 - rest
    heaviest = weights.detach().topk(min(_COLORED_SECTIONS, weights.shape[1]), dim=1).indices
    points = rays.at(middles.gather(1, heaviest))  # (R, K, 3)
    directions = torch.nn.functional.normalize(rays.directions, dim=1)[:, None].expand_as(points)
    flat = points.flatten(0, 1)
    with torch.no_grad():
        normals = torch.nn.functional.normalize(function.value_and_gradient(flat)[1], dim=1)
    with torch.set_grad_enabled(learning):
        hidden = function.mlp.hidden(function.encode(flat))
    colors = field.color(flat, directions.flatten(0, 1), normals, field.feature(hidden)).view_as(points)
    chosen = weights.gather(1, heaviest)
    share = chosen / chosen.sum(dim=1, keepdim=True).clamp_min(1e-6)  # the sections left out are colored alike
    color = opacity[:, None] * (share[..., None] * colors).sum(dim=1) + rest[:, None] * background
    depth = (weights * middles).sum(dim=1) / opacity.clamp_min(1e-6)
    return Rendered(color, depth, opacity)


def samples_about_depth(rays: PixelRays, bands: Tensor, generator: torch.Generator) -> Tensor:
    """(R, S) ascending depths: a few in free space, the others within ``bands`` (R,), field units, of the
    measured depth."""
    half = (bands / rays.directions.norm(dim=1))[:, None]
    measured = rays.depths[:, None]
    start = torch.minimum(rays.near[:, None], measured - 2.0 * half)
    free = start + (measured - half - start) * _stratified(len(rays), _FREE_SAMPLES, generator).to(half.device)
    close = measured - half + 2.0 * half * _stratified(len(rays), _BAND_SAMPLES, generator).to(half.device)
    return torch.cat((free, close), dim=1)


@torch.no_grad()
def samples_by_weight(
    function: NeusFactoFunction, rays: PixelRays, sharpness: Tensor, generator: torch.Generator
) -> Tensor:
    """(R, S) ascending depths within the bounds: an even half, and a half where the field's own weights are large.

    Importance sampling as in NeuS: the field is its own proposal.
    """
    span = (rays.far - rays.near)[:, None]
    even = rays.near[:, None] + span * _stratified(len(rays), _EVEN_SAMPLES, generator).to(span.device)
    weights, _ = render_weights(function.value(rays.at(even).flatten(0, 1)).view_as(even), sharpness)
    edges = torch.nn.functional.pad(torch.cumsum(weights + 1e-4, dim=1), (1, 0))
    edges = edges / edges[:, -1:]
    places = _stratified(len(rays), _EVEN_SAMPLES, generator).to(span.device)
    section = (torch.searchsorted(edges, places, right=True) - 1).clamp(0, weights.shape[1] - 1)
    low, high = edges.gather(1, section), edges.gather(1, section + 1)
    start, end = even.gather(1, section), even.gather(1, section + 1)
    chosen = start + (places - low) / (high - low).clamp_min(1e-9) * (end - start)
    return torch.cat((even, chosen), dim=1).sort(dim=1).values


def _stratified(rays: int, count: int, generator: torch.Generator) -> Tensor:
    return (torch.arange(count) + torch.rand(rays, count, generator=generator)) / count
