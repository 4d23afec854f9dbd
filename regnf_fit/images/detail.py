"""Where the surface that images show has detail: what a fit looks at more often than its share of the pixels.

Floors and walls fill most pixels of a room, and the coarse levels of a grid hold them.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from regnf_core.geometry.box import OrientedBox
from regnf_fit.images.cells import cells_of

_BOX_MARGIN = 0.1
_EDGE = 0.02
"""Of the cells in which surface is flat or not: diagonals of the bounds."""
_UNEVEN = 0.05
"""Edges: as far from a plane, as a root mean square, is surface in a cell that is not flat."""
_LEAST = 4
"""Points in a cell, to tell."""


def in_boxes(boxes: Sequence[OrientedBox], points: Tensor) -> Tensor:
    """(N,): whether points (N, 3) lie in any of the boxes, each a little grown."""
    inside = torch.zeros(len(points), dtype=torch.bool)
    for box in boxes:
        inside |= box.contains(points, _BOX_MARGIN)
    return inside


def uneven(points: Tensor, deviations: Tensor, size: float) -> Tensor:
    """(N,): whether the points in the cell of each lie farther from a plane than their noise explains.

    points: (N, 3) of measured surface · deviations: (N,) of their noise, 0 where unknown · size: the bounds' diagonal.
    """
    if len(points) == 0:
        return torch.zeros(0, dtype=torch.bool)
    edge = _EDGE * size
    cells = cells_of(points, edge)
    off = points.double() - cells.means(points)[cells.of]
    spread = cells.means((off[:, :, None] * off[:, None, :]).flatten(1)).view(-1, 3, 3)
    noise = cells.means(deviations.double().square()[:, None])[:, 0]
    thickness = torch.linalg.eigvalsh(spread)[:, 0] - noise
    found: Tensor = ((thickness > (_UNEVEN * edge) ** 2) & (cells.counts >= _LEAST))[cells.of]
    return found
