"""How large a network images need: a grid as fine as their pixels, with an entry for each cell that shows surface.

A hash grid covers [-2, 2]^3, whatever the bounds. In a room of that size a thing is a few per cent of it, and its
surface is only one of many that share the table: one size of grid cannot suit a cup and a room alike.
"""

from __future__ import annotations

import math
from dataclasses import replace

from regnf_core.schema.hash_grid_config import HashGridConfig
from regnf_fit.images.cells import cells_of
from regnf_fit.images.measured import ends_of, measured_rays, sharp_width
from regnf_fit.images.options import OF_IMAGES, ReconstructionOptions
from regnf_fit.images.preparation import PreparedImages
from regnf_fit.network import GRID_RADIUS
from regnf_fit.options import grid_of_levels

_LEVELS = {512: 8, 1024: 9}
"""Of a grid with so many nodes along an edge: neighboring levels differ by a factor of about 1.65."""
_LEAST_LOG2, _MOST_LOG2 = 15, 18


def suited(options: ReconstructionOptions, prepared: PreparedImages) -> ReconstructionOptions:
    """The options with the grid that these images ask for, where none was given."""
    return replace(options, grid=grid_of(prepared, options.table_log2)) if options.grid is OF_IMAGES else options


def grid_of(prepared: PreparedImages, table_log2: int | None = None) -> HashGridConfig:
    """The grid whose finest cells are about as wide as a pixel of the sharper images at its surface, and whose levels
    have an entry for every such cell that shows surface; within limits. Without depths: the smallest.

    table_log2: log2 of the entries a level, where they are given.
    """
    surface = measured_rays(prepared)
    if len(surface) == 0:
        return grid_of_levels(_LEVELS[min(_LEVELS)], min(_LEVELS), table_log2 or _LEAST_LOG2)
    width = sharp_width(prepared, surface)
    nodes = 2 ** math.ceil(math.log2(2.0 * GRID_RADIUS / width))
    nodes = min(max(nodes, min(_LEVELS)), max(_LEVELS))
    cells = cells_of(ends_of(surface), 2.0 * GRID_RADIUS / nodes)
    needed = min(max(math.ceil(math.log2(len(cells.counts))), _LEAST_LOG2), _MOST_LOG2)
    return grid_of_levels(_LEVELS[nodes], nodes, table_log2 or needed)
