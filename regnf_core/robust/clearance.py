"""How far from a measured surface an observation begins to know of free space.

Nearer to a measured surface than the noise of the depths, nothing is said to be free. And where depths of one surface
scatter, the voxels in which a surface was measured are a layer, and the surface lies within it. What tells whether a
surface element was seen from its front must look beyond both.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch.nn.functional import normalize

from regnf_core.fields.observation import Observation
from regnf_core.robust.constants import OCCLUSION
from regnf_core.robust.samples import fixed_generator
from regnf_core.schema.observation_grid import FREE, SURFACE


def clearance(observation: Observation) -> float:
    """Voxels from a voxel with a measured surface to the nearest free one: a quantile of them, within bounds (see
    ``OCCLUSION``).

    2 for exact depths, more for noisy ones. The same for every call.
    """
    states = observation.states
    drawn = torch.randint(states.numel(), (OCCLUSION.voxels_drawn,), generator=fixed_generator())
    measured = drawn[states.view(-1)[drawn] == SURFACE][: OCCLUSION.voxels_asked]
    if len(measured) == 0:
        return OCCLUSION.min_clearance
    centers = torch.stack(torch.unravel_index(measured, states.shape), -1)[:, None] + 0.5
    directions = torch.cartesian_prod(*[torch.tensor([-1.0, 0.0, 1.0])] * 3)
    directions = normalize(directions[directions.any(1)])
    grid = replace(observation, low=torch.zeros(3).double(), voxel=1.0, T_grid_frame=None)
    nearest = torch.full((len(centers),), OCCLUSION.max_clearance)
    for step in range(int(OCCLUSION.max_clearance), 0, -1):
        nearest[(grid.at(centers + step * directions) == FREE).any(1)] = float(step)
    return max(OCCLUSION.min_clearance, float(nearest.quantile(OCCLUSION.clearance_quantile)))
