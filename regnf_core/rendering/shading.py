"""The color of places that rays see: the field's own, or light and shade on a plain color; tinted where asked."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.editing.parts import Part, PartedField, Tint
from regnf_core.errors import InvalidInputError
from regnf_core.fields.base import SdfField
from regnf_core.fields.color import ColoredField, has_color, inverse_deviation_of
from regnf_core.rendering.options import RenderOptions
from regnf_core.rendering.samples import TileSamples
from regnf_core.surface.sphere_tracing import finite_distance, require_finite

_PLAIN: Tint = (0.88, 0.88, 0.86)
_HEADLIGHT, _SKY, _GROUND = 0.70, 0.34, 0.08
"""Shares of full light: from the camera, from above and from below."""
_OWN_UNDER_TINT = 0.35
"""How much of a field's own color is left under a tint."""
SHARP = 2000.0
"""Inverse deviation of a field that has none, times its bounds' diagonal: 90 % of the opacity within .3 % of it."""


@dataclass(frozen=True, eq=False)
class Painter:
    """Colors samples. parts: of the field · up: (3,), which way light comes from · options: of the rendering."""

    field: SdfField
    parts: tuple[Part, ...]
    up: Tensor
    options: RenderOptions

    @classmethod
    def of(cls, field: SdfField, up: Tensor, options: RenderOptions) -> Painter:
        """Raises InvalidInputError (COLORS_MISSING): colors are asked for, and no part has any."""
        parts = field.parts if isinstance(field, PartedField) else (Part(field, None),)
        if options.coloring == "field" and not any(has_color(part.field) for part in parts):
            message = "the field has no colors"
            hint = "Let it be shaded: coloring auto or shaded."
            raise InvalidInputError(message, reason="COLORS_MISSING", hint=hint)
        return cls(field, parts, up, options)

    def part_at(self, points: Tensor) -> Tensor:
        """(N,) int64, whose surface points (N, 3) belong to."""
        if isinstance(self.field, PartedField) and len(points):
            return self.field.part_at(points)
        return torch.zeros(len(points), dtype=torch.int64, device=points.device)

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

    def colors(self, samples: TileSamples, directions: Tensor) -> tuple[Tensor, Tensor]:
        """sRGB (M, 3) 0..1 of the samples, seen along unit ``directions`` (M, 3), and their parts (M,)."""
        part_at = self.part_at(samples.points)
        colors = samples.points.new_zeros(len(samples.points), 3)
        for number in torch.unique(part_at).tolist():
            chosen = (part_at == number).nonzero().squeeze(-1)
            args = samples.points[chosen], samples.normals[chosen], directions[chosen]
            colors[chosen] = self._part_colors(self.parts[number], *args)
        return colors, part_at

    def flat_colors(self, points: Tensor, directions: Tensor) -> Tensor:
        """sRGB (N, 3) of points (N, 3) without shading, seen along unit ``directions`` (N, 3)."""
        part_at = self.part_at(points)
        colors = torch.empty_like(points)
        for number in torch.unique(part_at).tolist():
            chosen, part = (part_at == number).nonzero().squeeze(-1), self.parts[number]
            tint = part.tint if self.options.tints else None
            if tint is None and self.options.coloring != "shaded" and has_color(part.field):
                colors[chosen] = _own_colors(part.field, part, points[chosen], directions[chosen])
            else:
                colors[chosen] = torch.tensor(tint or _PLAIN, device=points.device)
        return colors

    def _part_colors(self, part: Part, points: Tensor, normals: Tensor, directions: Tensor) -> Tensor:
        tint = part.tint if self.options.tints else None
        light = self._light(normals, directions)
        if self.options.coloring != "shaded" and has_color(part.field):
            own = _own_colors(part.field, part, points, directions)
            if tint is None:
                return own
            mixed = torch.tensor(tint, device=own.device) * light[:, None]
            gray = own.mean(-1, keepdim=True)
            return ((1.0 - _OWN_UNDER_TINT) * mixed + _OWN_UNDER_TINT * gray * mixed.clamp_min(0.2)).clamp(0.0, 1.0)
        base = torch.tensor(tint or _PLAIN, device=points.device)
        return (base * light[:, None]).clamp(0.0, 1.0)

    def _light(self, normals: Tensor, directions: Tensor) -> Tensor:
        """(M,): a lamp at the camera, and light from all around, more from above."""
        head = (-(normals * directions).sum(-1)).clamp_min(0.0)
        above = 0.5 + 0.5 * (normals @ self.up.to(normals))
        return _HEADLIGHT * head + _GROUND + (_SKY - _GROUND) * above

    def _sharpness_of(self, part: Part) -> float:
        if self.options.inverse_deviation is not None:
            return self.options.inverse_deviation
        scale = 1.0 if part.T_field_scene is None else float(part.T_field_scene.scale)
        learned = inverse_deviation_of(part.field)
        if learned is not None:
            return learned * scale
        low, high = part.field.bounds
        return SHARP / float((high - low).norm()) * scale


def _own_colors(field: ColoredField, part: Part, points: Tensor, directions: Tensor) -> Tensor:
    if part.T_field_scene is not None:
        points = part.T_field_scene.apply(points.double()).float()
        directions = directions @ part.T_field_scene.rotation.to(directions).T
    return field.color(points, directions).to(points).clamp(0.0, 1.0)
