"""The density of a radiance field: a hash grid (Müller et al. 2022), a small ReLU network, and the exponential.

Two layouts of the grid are known. tiny-cuda-nn's: see :class:`regnf_core.schema.hash_grid_config.HashGridConfig`.
nerfstudio's own, in plain PyTorch: every level is hashed and has 2^T entries, level l has floor(base growth^l) cells
along an edge, and its nodes are not shifted by half a cell.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from regnf_core.importing.arrays import Float32Array, tensor_error
from regnf_core.schema.hash_grid_config import HashGridConfig

Pairs = tuple[tuple[Float32Array, Float32Array], ...]
"""Weights (out, in) and biases (out,) of each layer; of the last, only the density's row."""
_PRIMES = (1, 2654435761, 805459861)
_AT_ONCE = 1 << 14
"""Points: what is computed for them stays in the processor's cache."""
_BLOCK = 16
"""Numbers of columns and of rows that networks of tiny-cuda-nn are filled up to."""
_MOST_HIDDEN = 8
_LEVEL_S, _WEIGHT_S = 8e-8, 2e-10
"""Seconds a point, of a level and of a weight of the network, as measured in 2026 on one core of a server."""
_LARGEST = 80.0
"""Of the exponent: beyond, a single-precision number overflows."""


@dataclass(frozen=True, eq=False)
class Level:
    """One lattice of a grid. scale: its cells along an edge of the unit cube · shift: of its nodes, in cells · stride:
    nodes along an edge of a dense one, 0 of one that is hashed · table: (E, F)."""

    scale: float
    shift: float
    stride: int
    table: Float32Array

    def features(self, points: Float32Array, smooth: bool) -> Float32Array:
        """(N, F), interpolated, at points (3, N) of the unit cube."""
        entries, width = self.table.shape
        position = points * np.float32(self.scale) + np.float32(self.shift)
        cell = np.floor(position)
        weights = position - cell
        if smooth:
            weights = weights * weights * (3.0 - 2.0 * weights)
        factors = (1, self.stride, self.stride**2 & 0xFFFFFFFF) if self.stride else _PRIMES
        step = np.array(factors, np.uint32)[:, None]
        lower = cell.astype(np.int64).astype(np.uint32) * step
        x, y, z = np.stack([lower, lower + step], axis=1)  # (2, N) each
        if self.stride:
            rows = ((x[:, None] + y)[:, :, None] + z) % np.uint32(entries)
        else:
            rows = ((x[:, None] ^ y)[:, :, None] ^ z) & np.uint32(entries - 1)
        whole = self.table.view(f"V{4 * width}")[:, 0]  # a row is moved as one element: that is several times faster
        values = whole.take(rows).view(np.float32).reshape(*rows.shape, width)
        for weight in weights:
            values = values[0] + (values[1] - values[0]) * weight[:, None]
        return np.asarray(values, np.float32)


def tiny_levels(config: HashGridConfig, table: Float32Array) -> tuple[Level, ...]:
    """As tiny-cuda-nn lays them out. table: all its numbers, as many as the config's entries have."""
    rows = table.reshape(-1, config.features_per_level)
    ends = np.cumsum((0, *config.level_entries()))
    strides = [nodes * dense for nodes, dense in zip(config.level_strides(), config.level_is_dense(), strict=True)]
    parts = [np.ascontiguousarray(rows[ends[level] : ends[level + 1]]) for level in range(config.levels)]
    each = zip(config.scales(), strides, parts, strict=True)
    return tuple(Level(scale, 0.5, stride, part) for scale, stride, part in each)


def plain_levels(base: int, top: int, table: Float32Array, count: int) -> tuple[Level, ...]:
    """As nerfstudio's plain PyTorch lays them out: ``count`` of them. The growth is rounded to float32, as it is there:
    2048 nodes become 2047."""
    growth = float(np.float32(math.exp((math.log(top) - math.log(base)) / (count - 1)) if count > 1 else 1.0))
    scales = [math.floor(base * np.float32(growth**level)) for level in range(count)]
    parts = np.ascontiguousarray(table).reshape(count, -1, table.shape[1])
    return tuple(Level(float(scale), 0.0, 0, part) for scale, part in zip(scales, parts, strict=True))


def fused_layers(flat: Float32Array, columns: int, hidden: int, rows: int = _BLOCK) -> Pairs:
    """The layers of a network of tiny-cuda-nn: matrices without biases, row after row, and nothing behind them.

    columns: of the first, a multiple of 16 · hidden: layers · rows: of the last. Raises FieldFormatError
    (TENSOR_SHAPE).
    """
    # hidden layers of w neurons have w (columns + rows) + (hidden - 1) w^2 numbers
    width = next((w for w in range(1, 1025) if w * (columns + rows + (hidden - 1) * w) >= flat.size), 0)
    if not 1 <= hidden <= _MOST_HIDDEN or width * (columns + rows + (hidden - 1) * width) != flat.size:
        message = f"{flat.size} numbers are no network of {columns} columns, {hidden} hidden layers and {rows} rows"
        raise tensor_error(message, "TENSOR_SHAPE")
    shapes = [(width, columns), *[(width, width)] * (hidden - 1), (rows, width)]
    ends = np.cumsum([high * wide for high, wide in shapes])[:-1]
    weights = [part.reshape(shape) for part, shape in zip(np.split(flat, ends), shapes, strict=True)]
    weights[-1] = weights[-1][:1]
    return tuple((weight, np.zeros(len(weight), np.float32)) for weight in weights)


@dataclass(frozen=True, eq=False)
class RadianceField:
    """density = factor exp(first result of the network). low, high: (3,), corners of the cube or box that the grid
    covers, of contracted space where ``contracted`` · near: the training sees nothing nearer to its cameras."""

    levels: tuple[Level, ...]
    layers: Pairs
    low: npt.NDArray[np.float64]
    high: npt.NDArray[np.float64]
    contracted: bool
    factor: float
    near: float
    smooth: bool = False

    @property
    def seconds(self) -> float:
        """About how long a point takes, on one core."""
        return _LEVEL_S * len(self.levels) + _WEIGHT_S * sum(weight.size for weight, _ in self.layers)

    def density(self, points: npt.NDArray[np.float64]) -> Float32Array:
        """(N,), per unit of the field's coordinates, at points (N, 3). None lies outside of what the grid covers."""
        found = np.empty(len(points), np.float32)
        for start in range(0, len(points), _AT_ONCE):
            part = slice(start, start + _AT_ONCE)
            found[part] = self._density(points[part])
        return found

    def _density(self, points: npt.NDArray[np.float64]) -> Float32Array:
        if self.contracted:  # by the largest coordinate: [-1, 1]^3 stays, all else goes to [-2, 2]^3
            size = np.abs(points).max(axis=1, keepdims=True).clip(1.0)
            points = (2.0 - 1.0 / size) * (points / size)
        unit = ((points - self.low) / (self.high - self.low)).T.astype(np.float32)
        inside = ((unit > 0.0) & (unit < 1.0)).all(axis=0)
        unit = np.ascontiguousarray(np.where(inside, unit, np.float32(0.0)))
        values: Float32Array = np.concatenate([level.features(unit, self.smooth) for level in self.levels], axis=1)
        for weight, bias in self.layers[:-1]:
            values = np.maximum(values @ weight.T + bias, np.float32(0.0))
        weight, bias = self.layers[-1]
        exponent = values @ weight[0] + bias[0]
        found = np.float32(self.factor) * np.exp(np.minimum(exponent, np.float32(_LARGEST)))
        return np.where(inside, found, np.float32(0.0))
