"""What counts as observed after the edits: there, everything does."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from regnf_core.fields.observation import Observation
from regnf_core.geometry.box import OrientedBox
from regnf_core.schema.observation_grid import FREE, SURFACE, UNSEEN

if TYPE_CHECKING:
    from regnf_core.editing.edited_scene import EditedScene


def observation_after(known: Observation, edited: EditedScene) -> Observation:
    """``known`` with the voxels of cleared places and of objects told from the edited scene: surface, free, or within
    matter, which nobody sees."""
    states = known.states.clone()
    boxes = [clearing.box for clearing in edited.clearings] + [thing.box for _, thing in edited.objects]
    for box in boxes:
        index = _voxels_of(known, box)
        if not len(index):
            continue
        points = _middles(known, index)
        distance = edited.signed_distance(points.float()).double().cpu()
        voxel = known.voxel if known.T_grid_frame is None else known.voxel / float(known.T_grid_frame.scale)
        state = torch.where(distance > 0, FREE, UNSEEN)
        state = torch.where(distance.abs() <= 0.5 * 3**0.5 * voxel, SURFACE, state).to(states.dtype)
        x, y, z = index.unbind(-1)
        states[x, y, z] = state
    return replace(known, states=states)


def _voxels_of(known: Observation, box: OrientedBox) -> Tensor:
    """(M, 3) int64, the voxels whose middles lie in ``box`` of the scene's frame."""
    corners = box.corners()
    if known.T_grid_frame is not None:
        corners = known.T_grid_frame.apply(corners)
    cells = (corners - known.low) / known.voxel
    low = cells.amin(0).floor().long().clamp_min(0)
    high = torch.minimum(cells.amax(0).ceil().long(), torch.tensor(known.states.shape))
    if bool((high <= low).any()):
        return torch.zeros(0, 3, dtype=torch.int64)
    index = torch.cartesian_prod(*(torch.arange(int(a), int(b)) for a, b in zip(low, high, strict=True)))
    return index[box.contains(_middles(known, index))]


def _middles(known: Observation, index: Tensor) -> Tensor:
    """(M, 3) float64, the voxels' middles in the scene's frame."""
    points = known.low + known.voxel * (index.double() + 0.5)
    return points if known.T_grid_frame is None else known.T_grid_frame.inverse().apply(points)
