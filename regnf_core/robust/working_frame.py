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
from regnf_core.robust.clearance import clearance
from regnf_core.robust.constants import EVIDENCE
from regnf_core.robust.devices import on_host
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
    """A field in its working frame: value and gradient at (M, 3) float32 points, results on the points' device.

    Points on the field's device are not copied. On the CPU, values are checked at once; elsewhere it would take a copy
    to ask, so what is not finite is remembered there until ``require_finite``.
    """

    def __init__(self, field: SdfField, frame: WorkingFrame) -> None:
        self.field = field
        self.frame = frame
        self._centers: dict[torch.device, Tensor] = {}
        self._not_finite: Tensor | None = None

    def value(self, points: Tensor) -> Tensor:
        """Signed distance (M,), working units. Raises InvalidInputError (FIELD_NOT_FINITE)."""
        distance = self.field.signed_distance(self._own(points)).to(points.device) / self.frame.length
        return self._finite(distance.float())

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (M,), working units, and its gradient (M, 3). Raises InvalidInputError (FIELD_NOT_FINITE)."""
        distance, gradient = self.field.signed_distance_and_gradient(self._own(points))
        distance, gradient = distance.to(points.device), gradient.to(points.device)
        return self._finite(distance.float() / self.frame.length), self._finite(gradient.float())

    def require_finite(self) -> None:
        """Raises InvalidInputError (FIELD_NOT_FINITE) where a value since the last call was not finite."""
        found, self._not_finite = self._not_finite, None
        if found is not None and bool(found):
            raise _not_finite()

    def _own(self, points: Tensor) -> Tensor:
        """Points (M, 3) in the field's frame, on its device."""
        center = self._centers.get(points.device)
        if center is None:
            center = self._centers[points.device] = self.frame.center.to(points.device)
        return (points.double() * self.frame.length + center).to(self.field.device)

    def _finite(self, values: Tensor) -> Tensor:
        faulty = ~torch.isfinite(values).all()
        if not on_host(values):
            self._not_finite = faulty if self._not_finite is None else self._not_finite | faulty
        elif bool(faulty):
            raise _not_finite()
        return values


@dataclass(frozen=True, eq=False)
class VoxelStates:
    """An observation's voxels, looked up in a working frame, or in that of each of H poses.

    states: (V,) uint8, z fastest · counts: (3,) int64 · turn: (..., 3, 3) and shift: (..., 3), float32: a point x is in
    the voxel floor(x turn + shift) · clearance: (...) float32, working units, see :mod:`regnf_core.robust.clearance`.
    """

    states: Tensor
    counts: Tensor
    turn: Tensor
    shift: Tensor
    clearance: Tensor

    @classmethod
    def of(cls, observation: Observation) -> VoxelStates:
        """For points of the observation's own frame, which T_grid_frame carries to the grid's."""
        T = Sim3.identity() if observation.T_grid_frame is None else observation.T_grid_frame
        to_cells = T.scale / observation.voxel
        return cls(
            observation.states.reshape(-1),
            torch.tensor(observation.states.shape),
            (to_cells * T.rotation).float().mT.contiguous(),
            ((T.translation - observation.low) / observation.voxel).float(),
            (clearance(observation) / to_cells).float(),
        )

    def to(self, device: torch.device) -> VoxelStates:
        """The same on another device."""
        parts = (self.states, self.counts, self.turn, self.shift, self.clearance)
        return VoxelStates(*(part.to(device) for part in parts))

    def at(self, points: Tensor) -> Tensor:
        """The states (..., M) at points (..., M, 3); UNSEEN beyond the grid."""
        cells = (points @ self.turn).add_(self.shift.unsqueeze(-2)).floor_().long()
        within = ((cells >= 0) & (cells < self.counts)).all(-1)
        x, y, z = torch.minimum(cells.clamp_min_(0), self.counts - 1).unbind(-1)
        index = x.mul(self.counts[1]).add_(y).mul_(self.counts[2]).add_(z)
        return torch.where(within, self.states[index], UNSEEN)

    def unobserved(self, points: Tensor, values: Tensor) -> Tensor:
        """(..., M) bool: which points (..., M, 3), with these signed distances (..., M) in object diameters, were not
        observed: those in unseen voxels, and those off the surface in voxels where one was measured. Such a voxel does
        not tell which part of it is free."""
        states = self.at(points)
        return (states == UNSEEN) | ((states == SURFACE) & (values.abs() > EVIDENCE.agreement))

    def facing_unseen(self, points: Tensor, normals: Tensor) -> Tensor:
        """(..., M) bool: no line of sight passed in front of surface elements at points (..., M, 3) with unit normals
        (..., M, 3)."""
        ahead = self.clearance[..., None, None] * normals
        return (self.at(points + 0.5 * ahead) != FREE) & (self.at(points + ahead) != FREE)


class WorkingObservation:
    """What was observed of a field, in its working frame: at (M, 3) float32 points on any device, results there."""

    def __init__(self, observation: Observation, frame: WorkingFrame) -> None:
        self._observation = observation.seen_in(frame.to_field())
        self._voxels = {torch.device("cpu"): VoxelStates.of(self._observation)}

    def to(self, device: torch.device | str) -> WorkingObservation:
        """Itself: it works where its points are."""
        del device
        return self

    def on(self, device: torch.device) -> VoxelStates:
        """The voxels for points of the working frame on the device; copied there once."""
        if device not in self._voxels:
            self._voxels[device] = self._voxels[torch.device("cpu")].to(device)
        return self._voxels[device]

    def measured_extent(self) -> Tensor | None:
        """(2, 3) float64: lowest and highest corner of where surface was measured; None where none was."""
        return self._observation.measured_extent()

    def on_surface(self, points: Tensor) -> Tensor:
        """(M,) bool: a surface was measured there."""
        return self.on(points.device).at(points) == SURFACE

    def unobserved(self, points: Tensor, values: Tensor) -> Tensor:
        """(M,) bool: neither was a surface measured there, nor did a line of sight pass through."""
        return self.on(points.device).unobserved(points, values)

    def faces_unobserved(self, points: Tensor, normals: Tensor) -> Tensor:
        """(M,) bool: no line of sight passed in front of these surface elements, whose unit normals are (M, 3)."""
        return self.on(points.device).facing_unseen(points, normals)


def _not_finite() -> InvalidInputError:
    return InvalidInputError("the field gives values that are not finite", reason="FIELD_NOT_FINITE")
