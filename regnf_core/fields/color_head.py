"""The small network that gives a point's color, from what the geometry's network computes and the line of sight."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from regnf_core.fields.hash_encoding import HashEncoding
from regnf_core.fields.observation import OnDevice
from regnf_core.schema.description import TABLE, NetworkColor
from regnf_core.schema.hash_grid_config import PositionalEncodingDescription
from regnf_core.schema.tensor_check import count_layers

# Sine and cosine features of a position, with their derivative.

_A, _B, _C, _D = 0.8506508, 0.5257311, 0.809017, 0.309017
_ICOSAHEDRON = (
    *((_A, 0.0, _B), (_C, 0.5, _D), (_B, _A, 0.0), (1.0, 0.0, 0.0), (_C, 0.5, -_D), (_A, 0.0, -_B), (_D, _C, -0.5)),
    *((0.0, _B, -_A), (0.5, _D, -_C), (0.0, 1.0, 0.0), (-_B, _A, 0.0), (-_D, _C, -0.5), (0.0, _B, _A)),
    *((-_D, _C, 0.5), (_D, _C, 0.5), (0.5, _D, _C), (0.5, -_D, _C), (0.0, 0.0, 1.0), (-0.5, _D, _C)),
    *((-_C, 0.5, _D), (-_C, 0.5, -_D)),
)
"""Corners and middles of an icosahedron's edges, one of each opposite pair, in the order of mip-NeRF 360's matrix P."""


@dataclass(frozen=True)
class PositionalEncoding:
    """sin and cos of every coordinate times base_frequency 2^k, k = 0 .. degree-1 (Mildenhall et al. 2020).

    Order: for each axis all frequencies, as sines; then the same block as cosines. ``off_axis``: in place of the three
    coordinates the lengths along 21 directions, those of an icosahedron (Barron et al. 2022).
    """

    degree: int
    base_frequency: float = 1.0
    """1 as sdfstudio has it, 2 pi as nerfstudio has it."""
    off_axis: bool = False

    @classmethod
    def of(cls, description: PositionalEncodingDescription | None) -> PositionalEncoding | None:
        if description is None or not description.used or not description.degree:
            return None
        frequency = 2.0 * math.pi if description.two_pi else 1.0
        return cls(description.degree, frequency * description.base_frequency, description.off_axis)

    @property
    def width(self) -> int:
        """Number of features of an encoded point."""
        return 2 * self.degree * (len(_ICOSAHEDRON) if self.off_axis else 3)

    def encode(self, points: Tensor) -> Tensor:
        """Features (N, 6 degree) at points (N, 3)."""
        angles = self._angles(points)
        return torch.cat((angles.sin(), angles.cos()), dim=-1)

    def pull_back(self, encoded: Tensor, gradient: Tensor) -> Tensor:
        """Gradient (N, 3) with respect to the points, from ``encoded`` and the gradient by it (both (N, 6 degree))."""
        sines, cosines = encoded.chunk(2, dim=-1)
        by_sine, by_cosine = gradient.chunk(2, dim=-1)
        by_angle = by_sine * cosines - by_cosine * sines  # (N, 3 degree)
        by_axis = by_angle.reshape(*by_angle.shape[:-1], by_angle.shape[-1] // self.degree, self.degree)
        by_length = (by_axis * self.frequencies(encoded)).sum(dim=-1)
        return by_length @ self.directions(encoded) if self.off_axis else by_length

    def _angles(self, points: Tensor) -> Tensor:
        lengths = points @ self.directions(points).T if self.off_axis else points
        return (lengths.unsqueeze(-1) * self.frequencies(points)).flatten(start_dim=1)

    @staticmethod
    def directions(like: Tensor) -> Tensor:
        """Those of ``off_axis`` (21, 3), of the type and on the device of ``like``."""
        return torch.tensor(_ICOSAHEDRON, dtype=like.dtype, device=like.device)

    def frequencies(self, like: Tensor) -> Tensor:
        """What the coordinates are multiplied by (degree,), of the type and on the device of ``like``."""
        return self.base_frequency * 2.0 ** torch.arange(self.degree, dtype=like.dtype, device=like.device)


# Real spherical harmonics of a direction, sorted and signed as tiny-cuda-nn has them.


def spherical_harmonics(directions: Tensor, degree: int) -> Tensor:
    """(N, degree^2) at unit directions (N, 3): all of orders below ``degree``, which is 1 to 4.

    Orthonormal on the sphere, with the Condon-Shortley sign.
    """
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    values = [torch.full_like(x, 0.28209479177387814)]
    if degree > 1:
        values += [-0.48860251190291987 * y, 0.48860251190291987 * z, -0.48860251190291987 * x]
    if degree > 2:
        values += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.94617469575755997 * zz - 0.31539156525251999,
            -1.0925484305920792 * x * z,
            0.54627421529603959 * (xx - yy),
        ]
    if degree > 3:
        values += [
            0.59004358992664352 * y * (yy - 3.0 * xx),
            2.8906114426405538 * x * y * z,
            0.45704579946446572 * y * (1.0 - 5.0 * zz),
            0.3731763325901154 * z * (5.0 * zz - 3.0),
            0.45704579946446572 * x * (1.0 - 5.0 * zz),
            1.4453057213202769 * z * (xx - yy),
            0.59004358992664352 * x * (3.0 * yy - xx),
        ]
    return torch.stack(values, dim=-1)


@dataclass(frozen=True)
class Appearance:
    """What the geometry gives its color at N points. position: (N, 3), contracted where the geometry sees it so ·
    gradient: (N, 3), by that position · hidden: (N, width), what the last layer is given."""

    position: Tensor
    gradient: Tensor
    hidden: Tensor


@dataclass(frozen=True)
class ColorHead(OnDevice):
    """[position, direction, gradient, grid, hidden] -> layers, ReLU between -> sigmoid -> color within [0, 1].

    weights[i]: (out_i, in_i) · biases[i]: (out_i,) · form: which inputs there are, and how they are encoded.
    """

    form: NetworkColor
    weights: tuple[Tensor, ...]
    biases: tuple[Tensor, ...]
    grid: HashEncoding | None = None
    """The color's own."""

    def __call__(self, appearance: Appearance, directions: Tensor) -> Tensor:
        """Color (N, 3) along unit ``directions`` (N, 3)."""
        last = len(self.weights) - 1
        h = torch.cat((*self._own_inputs(appearance, directions), appearance.hidden), dim=-1)
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            h = torch.addmm(bias, h, weight.T)
            if i < last:
                h = h.relu()
        color = h.sigmoid() if self.form.output == "sigmoid" else h
        padded = color * (1.0 + 2.0 * self.form.padding) - self.form.padding
        return padded.nan_to_num(0.0).clamp(0.0, 1.0)  # weights of any size overflow

    def with_first(self, weight: Tensor) -> ColorHead:
        """The same with other weights in the first layer."""
        return replace(self, weights=(weight, *self.weights[1:]))

    def _own_inputs(self, appearance: Appearance, directions: Tensor) -> list[Tensor]:
        form = self.form
        inputs = [appearance.position] if form.position else []
        if form.direction is not None and form.direction.encoding == "spherical_harmonics":
            inputs.append(spherical_harmonics(directions, form.direction.degree))
        elif form.direction is not None:
            frequency = 2.0 * torch.pi if form.direction.two_pi else 1.0
            inputs += [directions, PositionalEncoding(form.direction.degree, frequency).encode(directions)]
        if form.gradient == "unit":
            inputs.append(torch.nn.functional.normalize(appearance.gradient, dim=-1))
        elif form.gradient == "raw":
            inputs.append(appearance.gradient)
        if self.grid is not None:
            inputs.append(self.grid.encode((appearance.position + form.grid_radius) / (2.0 * form.grid_radius)))
        return inputs


def build_color_head(form: NetworkColor, tensors: Mapping[str, Tensor]) -> ColorHead:
    """The network of ``form`` with its layers in ``tensors`` (names without their beginning), in float32."""
    layers = range(count_layers(tensors))
    weights, biases = (tuple(tensors[f"layers.{i}.{part}"].float() for i in layers) for part in ("weight", "bias"))
    grid = None if form.hash is None else HashEncoding(form.hash, tensors[TABLE].float())
    return ColorHead(form, weights, biases, grid)
