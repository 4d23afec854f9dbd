"""The small network that gives a point's color, from what the geometry's network computes and the line of sight."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from regnf_core.fields.hash_encoding import HashEncoding
from regnf_core.fields.positional_encoding import PositionalEncoding
from regnf_core.fields.spherical_harmonics import spherical_harmonics
from regnf_core.schema.color import TABLE, NetworkColor
from regnf_core.schema.layers import count_layers


@dataclass(frozen=True)
class Appearance:
    """What the geometry gives its color at N points. position: (N, 3), contracted where the geometry sees it so ·
    gradient: (N, 3), by that position · hidden: (N, width), what the last layer is given."""

    position: Tensor
    gradient: Tensor
    hidden: Tensor


@dataclass(frozen=True)
class ColorHead:
    """[position, direction, gradient, grid, hidden] -> layers, ReLU between -> sigmoid -> color within [0, 1].

    weights[i]: (out_i, in_i) · biases[i]: (out_i,) · form: which inputs there are, and how they are encoded.
    """

    form: NetworkColor
    weights: tuple[Tensor, ...]
    biases: tuple[Tensor, ...]
    grid: HashEncoding | None = None
    """The color's own."""

    def to(self, device: torch.device | str) -> ColorHead:
        """The same on another device."""
        weights, biases = (tuple(tensor.to(device) for tensor in part) for part in (self.weights, self.biases))
        grid = None if self.grid is None else HashEncoding(self.grid.config, self.grid.table.to(device))
        return ColorHead(self.form, weights, biases, grid)

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
