"""A scene without the matter that nobody saw: invented behind things, and in the way of cameras there."""

from __future__ import annotations

import numpy as np
import torch
from scipy.ndimage import binary_dilation
from torch import Tensor

from regnf_core.editing.region import GridDistance, RegionGrid
from regnf_core.fields.base import SdfField
from regnf_core.fields.color import has_color, inverse_deviation_of
from regnf_core.fields.observation import Observation, observation_of
from regnf_core.fields.transformed import TransformedField, near_origin
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3
from regnf_core.schema.observation_grid import SURFACE

_AROUND = 2
"""Voxels round measured surface whose matter stays."""


class MeasuredMatter:
    """The scene's matter near where a surface was measured, as a shell of a few voxels; made by ``without_unseen``."""

    def __init__(self, scene: SdfField, shell: GridDistance) -> None:
        self.scene = scene
        self._shell = shell
        if has_color(scene):
            self.color = scene.color

    @property
    def bounds(self) -> Tensor:
        """(2, 3) float64 on the CPU: the scene's."""
        return self.scene.bounds

    @property
    def device(self) -> torch.device:
        return self.scene.device

    @property
    def observation(self) -> Observation | None:
        """The scene's."""
        return observation_of(self.scene)

    @property
    def inverse_deviation(self) -> float | None:
        """The scene's."""
        return inverse_deviation_of(self.scene)

    def to(self, device: torch.device | str) -> MeasuredMatter:
        """The same with its parameters on another device."""
        return MeasuredMatter(self.scene.to(device), self._shell)

    @torch.no_grad()
    def signed_distance(self, points: Tensor) -> Tensor:
        """Signed distance (N,) float32 at points (N, 3)."""
        points = points.to(device=self.device, dtype=torch.float32)
        return torch.maximum(self.scene.signed_distance(points).to(points), self._shell.at(points))

    @torch.no_grad()
    def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N,) and its gradient (N, 3) at points (N, 3)."""
        points = points.to(device=self.device, dtype=torch.float32)
        distance, gradient = (value.to(points) for value in self.scene.signed_distance_and_gradient(points))
        shell, slope = self._shell.at_with_gradient(points)
        beyond = shell > distance
        return torch.where(beyond, shell, distance), torch.where(beyond[:, None], slope, gradient)


def without_unseen(scene: SdfField) -> SdfField:
    """The scene without unobserved matter; itself where it does not know what was observed."""
    if observation_of(scene) is None:
        return scene
    near, origin = near_origin(scene)
    measured = _measured(near, observation_of(near))
    return TransformedField(measured, Sim3.from_translation(-origin)) if origin.any() else measured


def _measured(scene: SdfField, known: Observation | None) -> MeasuredMatter:
    assert known is not None
    shape = torch.tensor(known.states.shape, dtype=torch.float64)
    box = OrientedBox(known.low + known.voxel * shape / 2, known.voxel * shape, torch.eye(3, dtype=torch.float64))
    cell = known.voxel
    if known.T_grid_frame is not None:
        back = known.T_grid_frame.inverse()
        box = OrientedBox(back.apply(box.center[None])[0], box.size * back.scale, back.rotation)
        cell = cell * float(back.scale)
    x, y, z = known.states.shape
    surface = (known.states == SURFACE).numpy()
    near = np.asarray(binary_dilation(surface, iterations=_AROUND))
    return MeasuredMatter(scene, RegionGrid(box, cell, (x, y, z)).distance_to(near))
