"""A second, slow way to the same numbers: one point, one level, one corner at a time, in float64."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from regnf_core.schema.hash_grid_config import HashGridConfig

Array = NDArray[Any]


def encode_slowly(config: HashGridConfig, table: Array, unit_point: Array) -> Array:
    """Features (levels x features,) of one point (3,), by the published formulas."""
    features: list[Array] = []
    offset = 0
    for level in range(config.levels):
        growth = np.float32(2.0) ** (np.float32(level) * np.log2(np.float32(config.per_level_scale)))
        scale = float(np.float32(growth * np.float32(config.base_resolution) - np.float32(1.0)))
        resolution = math.ceil(scale) + 1
        entries = min((resolution**3 + 7) // 8 * 8, 2**config.log2_table_size)
        position = scale * unit_point + 0.5
        total = np.zeros(table.shape[1])
        for corner in itertools.product((0, 1), repeat=3):
            weight, node = 1.0, []
            for axis in range(3):
                cell = math.floor(position[axis])
                w = position[axis] - cell
                if config.interpolation == "smoothstep":
                    w = w * w * (3.0 - 2.0 * w)
                weight *= w if corner[axis] else 1.0 - w
                node.append((cell + corner[axis]) % 2**32)
            if resolution**3 <= entries:
                index = (node[0] + node[1] * resolution + node[2] * resolution**2) % 2**32
            else:
                index = node[0] ^ (node[1] * 2654435761 % 2**32) ^ (node[2] * 805459861 % 2**32)
            total += weight * table[offset + index % entries].astype(np.float64)
        features.append(total)
        offset += entries
    return np.concatenate(features)


def central_differences(function: Callable[[Array], Any], point: Array, step: float = 1e-6) -> Array:
    """Derivative of ``function`` at ``point`` (3,), stacked along the last axis."""
    columns = []
    for axis in range(3):
        aside = np.zeros(3)
        aside[axis] = step
        columns.append((np.asarray(function(point + aside)) - np.asarray(function(point - aside))) / (2.0 * step))
    return np.stack(columns, axis=-1)


def field_slowly(
    config: HashGridConfig, tensors: dict[str, Array], point: Array, *, two_pi: bool = False, contraction: str = "none"
) -> float:
    """Signed distance at one point (3,) of a field stored under the safe format's names, with degree 6."""
    largest = float(np.abs(point).max())
    contracted = point if largest < 1.0 else (2.0 - 1.0 / largest) * point / largest
    z = contracted if contraction == "linf" else point
    unit = ((point if contraction == "none" else contracted) + 2.0) / 4.0
    angles = [z[axis] * 2.0**k * (2.0 * math.pi if two_pi else 1.0) for axis in range(3) for k in range(6)]
    waves = [*z, *np.sin(angles), *np.sin(np.array(angles) + math.pi / 2)]
    features: Array = np.concatenate((waves, encode_slowly(config, tensors["hash_table"], unit)))
    layers = sum(name.endswith("weight") for name in tensors)
    h: Array = features
    for i in range(layers):
        if i == 4:
            h = np.concatenate((h, features)) / math.sqrt(2.0)
        h = tensors[f"layers.{i}.weight"].astype(np.float64) @ h + tensors[f"layers.{i}.bias"]
        if i < layers - 1:
            h = np.logaddexp(100.0 * h, 0.0) / 100.0
    return float(h[0])
