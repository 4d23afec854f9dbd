"""The shape that a field starts from: a ball of matter in free space, or a hollow ball in matter."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from regnf_data.posed_images import PosedImages
from regnf_fit.images.cells import cells_of
from regnf_fit.images.options import Start
from regnf_fit.images.rays import PixelRays
from regnf_fit.network import StartShape

_START_RADIUS = 0.2
"""Diagonals: smaller than most objects, so that what is seen grows from it."""
_CELL = 0.01
"""Diagonals: surface within one such cell counts once, however often it was measured."""


def start_shape(images: PosedImages, start: Start, measured: PixelRays) -> StartShape:
    """A ball in the middle of the bounds; for a room a hollow one, so large that all of the bounds is free.

    measured: the rays that end on a surface within the bounds, none without depths. By themselves they tell a room
    from a thing: its surface is seen from the side of the bounds' middle (:func:`faces_middle`). Without depths, the
    cameras tell it: most of them stand within the bounds.
    """
    low, high = images.bounds
    center, size = torch.from_numpy((low + high) / 2.0).float(), float(np.linalg.norm(high - low))
    if start == "auto" and len(measured) > 0:
        hollow = faces_middle(measured, center, size)
    else:
        cameras = images.T_world_camera[:, :3, 3]
        within = float(((cameras > low) & (cameras < high)).all(axis=1).mean())
        hollow = start == "room" or (start == "auto" and within > 0.5)
    return StartShape(center, (0.5 if hollow else _START_RADIUS) * size, hollow)


def faces_middle(measured: PixelRays, center: Tensor, size: float) -> bool:
    """Whether surface that was measured, at least one ray, is rather seen from the side of ``center`` (3,).

    It is the sign of the sum, over equal cells of surface, of (mean direction to the cameras) . (place - center): a
    convex thing seen from outside has a positive sum, a room seen from inside a negative one. size: the bounds'
    diagonal, field units.
    """
    ends = measured.at(measured.depths[:, None])[:, 0]
    cells = cells_of(ends, _CELL * size)
    towards_camera = cells.means(-torch.nn.functional.normalize(measured.directions, dim=1))
    return bool((towards_camera * (cells.means(ends) - center)).sum() < 0.0)
