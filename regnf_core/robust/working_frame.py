"""Working frames: both fields are centered and of size one, so that no number in this package depends on their
units."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.errors import InvalidInputError
from regnf_core.fields.base import SdfField
from regnf_core.fields.observation import Observation
from regnf_core.geometry.sim3 import Sim3
from regnf_core.robust.constants import OCCLUSION
from regnf_core.schema.observation_grid import FREE, SURFACE, UNSEEN


@dataclass(frozen=True, eq=False)
class WorkingFrame:
    """x_work = (x - center) / length. center: (3,) float64, field frame · length: field units."""

    center: Tensor
    length: float

    def into(self, points: Tensor) -> Tensor:
        """Points (N, 3) of the field's frame in the working frame, float32."""
        return ((points.double().cpu() - self.center) / self.length).float()

    def out_of(self, points: Tensor) -> Tensor:
        """Points (N, 3) of the working frame in the field's frame, float64."""
        return points.double().cpu() * self.length + self.center

    def to_field(self) -> Sim3:
        """The working frame's points in the field's frame."""
        return Sim3(
            torch.tensor(self.length, dtype=torch.float64), torch.eye(3, dtype=torch.float64), self.center.clone()
        )


class WorkingField:
    """A field in its working frame: value and gradient at (M, 3) float32 points on the CPU, results on the CPU."""

    def __init__(self, field: SdfField, frame: WorkingFrame) -> None:
        self.field = field
        self.frame = frame

    def value(self, points: Tensor) -> Tensor:
        """Signed distance (M,), working units. Raises InvalidInputError (FIELD_NOT_FINITE)."""
        distance = self.field.signed_distance(self._own(points)).cpu() / self.frame.length
        return _finite(distance.float())

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (M,), working units, and its gradient (M, 3). Raises InvalidInputError (FIELD_NOT_FINITE)."""
        distance, gradient = self.field.signed_distance_and_gradient(self._own(points))
        return _finite(distance.cpu().float() / self.frame.length), _finite(gradient.cpu().float())

    def _own(self, points: Tensor) -> Tensor:
        return self.frame.out_of(points).float().to(self.field.device)


class WorkingObservation:
    """What was observed of a field, in its working frame: at (M, 3) float32 points on the CPU."""

    def __init__(self, observation: Observation, frame: WorkingFrame) -> None:
        self._observation = observation.seen_in(frame.to_field())
        T_grid_frame = self._observation.T_grid_frame
        assert T_grid_frame is not None
        to_cells = T_grid_frame.scale / observation.voxel
        self._voxel = float(1.0 / to_cells)
        self._turn = (to_cells * T_grid_frame.rotation).float().T.contiguous()
        self._shift = ((T_grid_frame.translation - observation.low) / observation.voxel).float()
        self._counts = torch.tensor(observation.states.shape)
        self._states = observation.states.reshape(-1)

    def measured_extent(self) -> Tensor | None:
        """(2, 3) float64: lowest and highest corner of where surface was measured; None where none was."""
        return self._observation.measured_extent()

    def on_surface(self, points: Tensor) -> Tensor:
        """(M,) bool: a surface was measured there."""
        return self._at(points) == SURFACE

    def unobserved(self, points: Tensor, values: Tensor) -> Tensor:
        """(M,) bool: neither was a surface measured there, nor did a line of sight pass through. values: not needed."""
        del values
        return self._at(points) == UNSEEN

    def faces_unobserved(self, points: Tensor, normals: Tensor) -> Tensor:
        """(M,) bool: no line of sight passed in front of these surface elements, whose unit normals are (M, 3)."""
        near, far = (points + step * self._voxel * normals for step in OCCLUSION.front_voxels)
        return (self._at(near) != FREE) & (self._at(far) != FREE)

    def _at(self, points: Tensor) -> Tensor:
        """The states (M,) at points (M, 3); UNSEEN beyond the grid."""
        cells = torch.addmm(self._shift, points, self._turn).floor_().long()
        within = ((cells >= 0) & (cells < self._counts)).all(-1)
        x, y, z = torch.minimum(cells.clamp_min_(0), self._counts - 1).unbind(-1)
        index = x.mul(self._counts[1]).add_(y).mul_(self._counts[2]).add_(z)
        return torch.where(within, self._states[index], UNSEEN)


def _finite(values: Tensor) -> Tensor:
    if not torch.isfinite(values).all():
        raise InvalidInputError("the field gives values that are not finite", reason="FIELD_NOT_FINITE")
    return values
