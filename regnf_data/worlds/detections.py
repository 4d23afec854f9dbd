"""Detection boxes as detectors give them: too large, off center, turned any way."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from regnf_core.geometry.box import OrientedBox
from regnf_data.worlds.mesh import Array

LOOSE = (0.1, 0.2)
"""By how much an edge is too long."""
SHIFT = 0.05
"""Largest shift along an axis, a share of the edge."""
_TURN_SHARES = (0.5, 0.3, 0.2)


def draw_box(points: Array, T_turn: Array, rng: np.random.Generator) -> OrientedBox:
    """A box about points (N, 3): level and along the axes, along those of ``T_turn`` (4, 4), or turned any way."""
    way = int(rng.choice(3, p=_TURN_SHARES))
    turned: Array = np.asarray(Rotation.random(random_state=int(rng.integers(2**31))).as_matrix())
    R = (np.eye(3), T_turn[:3, :3], turned)[way]
    local = points @ R
    low, high = local.min(axis=0), local.max(axis=0)
    size = np.maximum(high - low, 0.02 * (high - low).max())
    middle = (low + high) / 2.0 + rng.uniform(-SHIFT, SHIFT, 3) * size
    loose = size * (1.0 + rng.uniform(*LOOSE, 3))
    return OrientedBox(torch.from_numpy(R @ middle), torch.from_numpy(loose), torch.from_numpy(R.copy()))
