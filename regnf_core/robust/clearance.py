"""How far from a measured surface an observation begins to know of free space.

Nearer to a measured surface than the noise of the depths, nothing is said to be free. And where depths of one surface
scatter, the voxels in which a surface was measured are a layer, and the surface lies within it. What tells whether a
surface element was seen from its front must look beyond both.
"""

from __future__ import annotations

import torch

from regnf_core.fields.observation import Observation
from regnf_core.robust.constants import OCCLUSION
from regnf_core.robust.samples import fixed_generator
from regnf_core.schema.observation_grid import FREE, SURFACE


def clearance(observation: Observation) -> float:
    """Voxels from a voxel with a measured surface to the nearest free one: a quantile of them, within bounds (see
    ``OCCLUSION``).

    2 for exact depths, more for noisy ones. The same for every call.
    """
    generator = fixed_generator()
    states = observation.states
    drawn = torch.randint(states.numel(), (OCCLUSION.voxels_drawn,), generator=generator)
    cells = torch.stack(torch.unravel_index(drawn[states.view(-1)[drawn] == SURFACE], states.shape), -1)
    if len(cells) == 0:
        return OCCLUSION.min_clearance
    centers = cells[: OCCLUSION.voxels_asked, None] + 0.5
    directions = torch.cartesian_prod(*[torch.tensor([-1.0, 0.0, 1.0])] * 3)
    directions = torch.nn.functional.normalize(directions[directions.any(1)])
    limits = torch.tensor(states.shape)
    nearest = torch.full((len(centers),), OCCLUSION.max_clearance)
    for step in range(int(OCCLUSION.max_clearance), 0, -1):
        x, y, z = (places := (centers + step * directions).floor().long()).clamp_min(0).minimum(limits - 1).unbind(-1)
        within = ((places >= 0) & (places < limits)).all(-1)
        nearest[((states[x, y, z] == FREE) & within).any(1)] = float(step)
    return max(OCCLUSION.min_clearance, float(nearest.quantile(OCCLUSION.clearance_quantile)))
