"""Where rays enter and leave an axis-aligned box."""

from __future__ import annotations

import torch
from torch import Tensor


def ray_box_interval(origins: Tensor, directions: Tensor, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Entry (R,), at least 0, and exit (R,) of rays in multiples of their directions; exit <= entry: the ray misses.

    origins, directions: (R, 3), the directions of any length · low, high: (3,) corners; all in one frame and dtype.
    A ray that runs within a face counts as inside that face.
    """
    first, second = (low - origins) / directions, (high - origins) / directions
    # 0 / 0, a ray within a face: the face does not cut it off
    lowest = torch.minimum(first, second).nan_to_num(nan=-torch.inf, posinf=torch.inf, neginf=-torch.inf)
    highest = torch.maximum(first, second).nan_to_num(nan=torch.inf, posinf=torch.inf, neginf=-torch.inf)
    return lowest.amax(-1).clamp_min(0.0), highest.amin(-1)
