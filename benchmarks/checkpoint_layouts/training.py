"""A few steps of training: a hash grid and a small network towards the distances of a random solid."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from benchmarks.checkpoint_layouts.settings import Settings
from benchmarks.checkpoint_layouts.shapes import random_shape
from regnf_core.fields.color_head import PositionalEncoding
from regnf_core.fields.hash_encoding import HashEncoding
from regnf_core.fields.neus_facto_function import GeometryMlp, NeusFactoFunction
from regnf_core.schema.kinds import SKIP_LAYER

_BATCH = 1024
_INITIAL = 1e-4
"""tiny-cuda-nn begins with features between -1e-4 and 1e-4."""


@dataclass
class Trained:
    """Tensors of a field: table (entries, features), weights[i] (out, in), biases[i] (out,)."""

    table: Tensor
    weights: list[Tensor]
    biases: list[Tensor]


def train(settings: Settings, seed: int) -> Trained:
    """The field of ``settings`` after its steps of training; with none of them, as it was initialized."""
    generator = torch.Generator().manual_seed(seed)
    field = _initial(settings, generator)
    shape = random_shape(generator)
    if settings.steps == 0:
        return field
    layers = [*field.weights, *field.biases]
    for tensor in (field.table, *layers):
        tensor.requires_grad_(True)
    groups = [{"params": [field.table], "lr": 1e-2}, {"params": layers, "lr": 2e-3}]
    optimizer = torch.optim.Adam(groups, eps=1e-15)
    for _ in range(settings.steps):
        points = settings.radius * (2.0 * torch.rand(_BATCH, 3, generator=generator) - 1.0)
        near = points[: _BATCH // 2]
        with torch.no_grad():  # half of the points near the surface
            near -= 0.9 * shape(near)[:, None] * torch.nn.functional.normalize(_slope(shape, near), dim=-1)
        target, slope = shape(points), _slope(shape, points)
        distance, gradient = function_of(settings, field).value_and_gradient(points)
        loss = (distance - target).abs().mean() + 0.1 * (gradient - slope).square().mean()
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    for tensor in (field.table, *layers):
        tensor.requires_grad_(False)
    return field


def function_of(settings: Settings, field: Trained) -> NeusFactoFunction:
    """The function that the trainer of ``settings`` evaluates."""
    sines = PositionalEncoding(settings.degree, 2.0 * math.pi if settings.two_pi else 1.0)
    mask = _fed_columns(settings)
    weights = [field.weights[0] * mask, *field.weights[1:]]
    if len(weights) > SKIP_LAYER:
        hidden = weights[SKIP_LAYER - 1].shape[0]
        weights[SKIP_LAYER] = weights[SKIP_LAYER] * torch.cat((torch.ones(hidden), mask))
    return NeusFactoFunction(
        GeometryMlp(weights, field.biases, SKIP_LAYER),
        sines if settings.degree else None,
        HashEncoding(settings.grid, field.table),
        "linf_grid" if settings.two_pi else "none",
        settings.grid_radius,
    )


def _fed_columns(settings: Settings) -> Tensor:
    """(input_width,): 1 for columns that are ever fed something but zero, 0 for the others."""
    mask = torch.ones(settings.input_width)
    grid = 3 + 6 * settings.degree
    if not settings.uses_sines:
        mask[3:grid] = 0.0
    opened = settings.open_levels if settings.uses_grid else 0
    mask[grid + opened * settings.grid.features_per_level :] = 0.0
    return mask


def _initial(settings: Settings, generator: torch.Generator) -> Trained:
    """Geometric initialization (Atzmon and Lipman 2020), a sphere."""
    widths = [settings.input_width, *[settings.hidden] * settings.hidden_layers, settings.outputs]
    weights, biases = [], []
    for layer, (columns, rows) in enumerate(itertools.pairwise(widths)):
        skipped = settings.input_width if settings.hidden_layers > 4 and layer in (SKIP_LAYER - 1, SKIP_LAYER) else 0
        rows -= skipped if layer == SKIP_LAYER - 1 else 0
        weight = torch.randn(rows, columns, generator=generator) * (2.0 / rows) ** 0.5
        bias = torch.zeros(rows)
        last = layer == len(widths) - 2
        if last:
            weight = (torch.pi / columns) ** 0.5 + 1e-4 * torch.randn(rows, columns, generator=generator)
            bias -= 0.5 * settings.radius
        elif layer == 0:
            weight[:, 3:] = 0.0
        elif layer == SKIP_LAYER and skipped:
            weight[:, -(settings.input_width - 3) :] = 0.0
        weights.append(weight)
        biases.append(bias)
    table = _INITIAL * (
        2.0 * torch.rand(settings.grid.entries, settings.grid.features_per_level, generator=generator) - 1.0
    )
    return Trained(table, weights, biases)


def _slope(shape: object, points: Tensor) -> Tensor:
    with torch.enable_grad():
        leaf = points.detach().requires_grad_(True)
        (slope,) = torch.autograd.grad(shape(leaf).sum(), leaf)  # type: ignore[operator]
    return slope
