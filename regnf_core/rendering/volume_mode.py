"""Volume rendering as in NeuS (Wang et al. 2021): opacity from the signed distances of consecutive samples.

alpha_i = max((Phi(s d_i) - Phi(s d_i+1)) / Phi(s d_i), 0), Phi the sigmoid (equation 13). Where the distance falls
along a ray, the products of 1 - alpha telescope: the transmittance does not depend on where the samples lie. So steps
are as long as sphere tracing allows, and about 1 / s where the opacity changes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.editing.edits import Part, PartedField, Tint
from regnf_core.errors import InvalidInputError
from regnf_core.fields.observation import SdfField, has_color, inverse_deviation_of
from regnf_core.rendering.camera import up_vector
from regnf_core.rendering.request import RenderOptions
from regnf_core.rendering.tracing import Region, Start
from regnf_core.surface.sphere_tracing import Rays, finite_distance, require_finite

# What was found along the rays of a tile.


@dataclass(frozen=True)
class TileSamples:
    """Places where rays see something, for shading.

    ray: (M,) int64 · points: (M, 3) · normals: (M, 3) unit, 0 where the gradient vanishes · weight: (M,), of a ray's
    color; a ray's weights add up to its opacity · opacity: (N,) and length: (N,) along the ray, of each of N rays;
    length means nothing where the opacity is 0.
    """

    ray: Tensor
    points: Tensor
    normals: Tensor
    weight: Tensor
    opacity: Tensor
    length: Tensor


Medium = Callable[[Tensor], tuple[Tensor, Tensor]]
"""The distance (N,) and the inverse deviation s (N,) at points (N, 3), per scene unit."""
CLEAR = 4.0
"""s d up to which steps are long: the opacity between two samples depends on their distances alone, so nothing of it is
lost; only its place would be less exact."""
_FINE = 1.0
"""How much s d changes in a step below that, about."""
_SLOWEST = 0.5
"""Least change of the distance along a ray, per length, that steps are told by."""
_SHARE = 0.9
_MOST_STEPS = 1024
_OPAQUE = 5e-3
"""Transmittance at which a ray ends."""
_LEAST_WEIGHT = 0.03
"""Of samples that are shaded, as a share of their ray's opacity; the others' weight is shared out among them."""
_LEAST_OPACITY = 1e-3
"""What is less opaque is not seen."""


def volume_samples(region: Region, rays: Rays, start: Start, medium: Medium, least: float) -> TileSamples:
    """The samples of all rays that add to what is seen, and the mean length of each ray by weight.

    medium: of the field · least: s anywhere.
    """
    count = len(rays.origins)
    passed = rays.origins.new_ones(count)
    weighted = torch.zeros_like(passed)
    kept: list[tuple[Tensor, Tensor, Tensor]] = []
    index = (region.exit > start.length).nonzero().squeeze(-1)
    t = start.length[index]
    last_t, last_d, last_s = t.clone(), torch.full_like(t, torch.nan), torch.ones_like(t)
    for _ in range(_MOST_STEPS):
        if index.numel() == 0:
            break
        points = rays.origins[index] + t[:, None] * rays.directions[index]
        # the field's where the opacity may change, a lower bound and ``least`` elsewhere
        d = region.grid.at(points)
        s = torch.full_like(d, least)
        asked = (d <= 2.0 * CLEAR / least).nonzero().squeeze(-1)
        d[asked], s[asked] = medium(points[asked])
        alpha = _alpha(last_s * last_d, last_s * d)
        weight = passed[index] * alpha
        passed[index] = passed[index] * (1.0 - alpha)
        middle = last_t + (t - last_t) * _mean_share(last_s * last_d, s * d)
        weighted[index] += weight * middle
        seen = weight > _LEAST_OPACITY
        kept.append((index[seen], middle[seen], weight[seen]))
        approach = ((last_d - d).abs() / (t - last_t).clamp_min(1e-12)).nan_to_num(1.0).clamp(_SLOWEST, 1.0)
        onward = torch.maximum(_SHARE * (d - CLEAR / s), _FINE / (s * approach)).clamp_min(region.shortest / 4)
        last_t, last_d, last_s, t = t, d, s, t + onward
        going = (passed[index] > _OPAQUE) & (last_t < region.exit[index])
        index, t, last_t, last_d, last_s = (part[going] for part in (index, t, last_t, last_d, last_s))
    opacity = 1.0 - passed
    length = weighted / opacity.clamp_min(1e-6)
    empty = opacity.new_zeros(0)
    ray, t, weight = (torch.cat(values) for values in zip(*(kept or [(empty.long(), empty, empty)]), strict=True))
    shaded = weight > _LEAST_WEIGHT * opacity[ray]
    ray, t, weight = ray[shaded], t[shaded], weight[shaded]
    total = torch.zeros_like(opacity).index_add_(0, ray, weight)
    weight = weight * (opacity / total.clamp_min(1e-9))[ray]
    opacity = torch.where(total > 0, opacity, 0.0)
    points = rays.origins[ray] + t[:, None] * rays.directions[ray]
    gradient = region.field.signed_distance_and_gradient(points)[1].to(points)
    return TileSamples(ray, points, torch.nn.functional.normalize(gradient, dim=-1), weight, opacity, length)


def _alpha(before: Tensor, after: Tensor) -> Tensor:
    """(N,), of s times the distances; 0 where there is no sample before."""
    # Phi(a) - Phi(b) over Phi(a) = 1 - Phi(b) / Phi(a), in logarithms: exact far inside matter as well
    alpha = -torch.expm1(torch.nn.functional.logsigmoid(after) - torch.nn.functional.logsigmoid(before))
    return torch.nan_to_num(alpha, nan=0.0).clamp(0.0, 1.0)


def _mean_share(before: Tensor, after: Tensor) -> Tensor:
    """(N,), 0..1: the mean place of a segment's opacity, of s times the distances at its ends, linear between them.

    With T = Phi(d) / Phi(before) the transmittance, the mean is the integral of T less its last value, over its fall;
    and the integral of the sigmoid is softplus.
    """
    a, b = before.double(), after.double()
    fall = torch.sigmoid(a) - torch.sigmoid(b)
    integral = (torch.nn.functional.softplus(a) - torch.nn.functional.softplus(b)) / (a - b)
    share = (integral - torch.sigmoid(b)) / fall
    return torch.where((fall > 1e-9) & ((a - b) > 1e-4), share, 0.5).clamp(0.0, 1.0).to(before)


# The color of places that rays see: the field's own, or light and shade on a plain color; tinted where asked.

_PLAIN: Tint = (0.88, 0.88, 0.86)
_HEADLIGHT, _SKY, _GROUND = 0.70, 0.34, 0.08
"""Shares of full light: from the camera, from above and from below."""
_OWN_UNDER_TINT = 0.35
"""How much of a field's own color is left under a tint."""
_SHARP = 2000.0
"""Inverse deviation of a field that has none, times its bounds' diagonal: 90 % of the opacity within 0.3 % of it."""


@dataclass(frozen=True, eq=False)
class Painter:
    """Colors samples. parts: of the field · up: (3,), which way light comes from · options: of the rendering."""

    field: SdfField
    parts: tuple[Part, ...]
    up: Tensor
    options: RenderOptions

    @classmethod
    def of(cls, field: SdfField, options: RenderOptions) -> Painter:
        """Raises InvalidInputError (COLORS_MISSING): colors are requested, and no part has any."""
        parts = field.parts if isinstance(field, PartedField) else (Part(field, None),)
        if options.coloring == "field" and not any(has_color(part.field) for part in parts):
            hint = "Use coloring auto or shaded."
            raise InvalidInputError("the field has no colors", reason="COLORS_MISSING", hint=hint)
        return cls(field, parts, up_vector(options.up).float(), options)

    def distance_and_sharpness(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N,) at points (N, 3), and NeuS's s (N,) there, per scene unit: each part's own.

        Raises InvalidInputError (FIELD_NOT_FINITE).
        """
        each = [self._sharpness_of(part) for part in self.parts]
        if len(set(each)) == 1 or not isinstance(self.field, PartedField):
            return finite_distance(self.field, points), points.new_full((len(points),), each[0])
        distance, part = self.field.signed_distance_and_part(points)
        require_finite(distance)
        return distance.to(points), torch.tensor(each, device=points.device)[part]

    @property
    def least_sharpness(self) -> float:
        """The least s of all parts."""
        return min(self._sharpness_of(part) for part in self.parts)

    def colors(self, points: Tensor, directions: Tensor, normals: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """sRGB (N, 3) 0..1 of points (N, 3) seen along unit ``directions`` (N, 3), and their parts (N,) int64.

        normals: (N, 3) unit; None: without shading.
        """
        part_at = torch.zeros(len(points), dtype=torch.int64, device=points.device)
        if isinstance(self.field, PartedField) and len(points):
            part_at = self.field.part_at(points)
        colors = torch.empty_like(points)
        for number in torch.unique(part_at).tolist():
            chosen = (part_at == number).nonzero().squeeze(-1)
            shading = None if normals is None else normals[chosen]
            colors[chosen] = self._part_colors(self.parts[number], points[chosen], directions[chosen], shading)
        return colors, part_at

    def _part_colors(self, part: Part, points: Tensor, directions: Tensor, normals: Tensor | None) -> Tensor:
        tint = part.tint if self.options.tints else None
        own = None if self.options.coloring == "shaded" else part.color(points, directions)
        if own is not None and tint is None:
            return own.clamp(0.0, 1.0)
        plain = torch.tensor(tint or _PLAIN, device=points.device)
        if normals is None:
            return plain.expand_as(points)
        # a lamp at the camera, and light from all around, more from above
        head = (-(normals * directions).sum(-1)).clamp_min(0.0)
        above = 0.5 + 0.5 * (normals @ self.up.to(normals))
        lit = plain * (_HEADLIGHT * head + _GROUND + (_SKY - _GROUND) * above)[:, None]
        if own is None:
            return lit.clamp(0.0, 1.0)
        gray = own.clamp(0.0, 1.0).mean(-1, keepdim=True)
        return ((1.0 - _OWN_UNDER_TINT) * lit + _OWN_UNDER_TINT * gray * lit.clamp_min(0.2)).clamp(0.0, 1.0)

    def _sharpness_of(self, part: Part) -> float:
        if self.options.inverse_deviation is not None:
            return self.options.inverse_deviation
        scale = 1.0 if part.T_field_scene is None else float(part.T_field_scene.scale)
        learned = inverse_deviation_of(part.field)
        if learned is not None:
            return learned * scale
        low, high = part.field.bounds
        return _SHARP / float((high - low).norm()) * scale
