"""Hash tables that hold a known shape: one dense level has a ball's distance at its nodes, all others are zero."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from regnf_core.schema.hash_grid_config import HashGridConfig

Array = NDArray[np.float32]


def ball_table(config: HashGridConfig, level: int, radius: float = 0.5, grid_radius: float = 1.0) -> Array:
    """(entries, features_per_level): the first feature of ``level`` is the distance to a ball round the origin.

    The grid covers [-grid_radius, grid_radius]^3; node c of a level of scale s lies at (c - 1/2) / s of the unit cube.
    """
    assert config.level_is_dense()[level]
    nodes, scale = config.level_strides()[level], config.scales()[level]
    axis = ((np.arange(nodes) - 0.5) / scale * 2.0 - 1.0) * grid_radius
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")  # x runs fastest
    table = np.zeros((config.entries, config.features_per_level), dtype=np.float32)
    start = sum(config.level_entries()[:level])
    distance = np.sqrt(x * x + y * y + z * z) - radius
    table[start : start + nodes**3, 0] = distance.ravel()
    return table


def passing_network(input_width: int, skipped: int = 3) -> list[tuple[Array, Array]]:
    """Two layers, (weight, bias) each, that give the sum of all inputs but the first ``skipped``.

    softplus(a) - softplus(-a) = a, so the activation between them leaves the sum as it is.
    """
    first = np.ones((2, input_width), dtype=np.float32)
    first[:, :skipped] = 0.0
    first[1] *= -1.0
    zeros: Any = np.zeros
    return [(first, zeros(2, np.float32)), (np.array([[1.0, -1.0]], dtype=np.float32), zeros(1, np.float32))]
