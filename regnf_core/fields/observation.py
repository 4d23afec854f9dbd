"""The observation of a field: where a surface was measured, where free space was observed, and what is unobserved.

A field has a value everywhere, whether anything was measured there or not. Fields that were fitted to images or depths
can say which is which; those that cannot have no observation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any, Protocol, Self, TypeGuard, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from regnf_core.geometry.sim3 import Sim3
from regnf_core.library_entries import shown_number
from regnf_core.native.steps import NativeModel, native_model
from regnf_core.schema.description import SURFACE, UNSEEN, ObservationGrid

# What every field offers, whatever made it: signed distance, its gradient, its bounds.


@runtime_checkable
class SdfField(Protocol):
    """A signed distance field: positive in free space, negative inside matter, in units of its own frame.

    Implementations evaluate without building an autograd graph, in chunks that bound memory, in float32, on ``device``.
    Use :func:`differentiable_signed_distance` where a loss must flow back to the points.
    """

    @property
    def bounds(self) -> Tensor:
        """(2, 3) float64 on the CPU: lowest and highest corner of the region where the field has meaning, own frame."""
        ...

    @property
    def device(self) -> torch.device:
        """Where the field's parameters live; points are moved there."""
        ...

    def to(self, device: torch.device | str) -> SdfField:
        """The same field with its parameters on another device."""
        ...

    def signed_distance(self, points: Tensor) -> Tensor:
        """Signed distance (N,) float32 at points (N, 3) in the field's frame."""
        ...

    def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N,) and its gradient (N, 3) with respect to the points (N, 3)."""
        ...


def field_repr(field: SdfField) -> str:
    """A field in a line: its class, and where it has meaning."""
    low, high = (f"[{', '.join(map(shown_number, corner.tolist()))}]" for corner in field.bounds)
    return f"<{type(field).__name__}, bounds {low} to {high}, {field.device}>"


class _SignedDistance(torch.autograd.Function):
    """Signed distance whose backward pass uses the field's own gradient: no graph through the network is kept."""

    @staticmethod
    def forward(ctx: torch.autograd.function.FunctionCtx, points: Tensor, field: SdfField) -> Tensor:
        distance, gradient = field.signed_distance_and_gradient(points.detach())
        ctx.save_for_backward(gradient)
        return distance.to(points)

    @staticmethod
    def backward(ctx: torch.autograd.function.FunctionCtx, *grad_outputs: Tensor) -> tuple[Tensor, None]:
        (gradient,) = ctx.saved_tensors  # type: ignore[attr-defined]
        return grad_outputs[0].unsqueeze(-1) * gradient.to(grad_outputs[0]), None


def differentiable_signed_distance(field: SdfField, points: Tensor) -> Tensor:
    """Signed distance (N,) at points (N, 3) that autograd can differentiate once with respect to the points."""
    return _SignedDistance.apply(points, field)  # type: ignore[no-untyped-call, no-any-return]


# What a field with color offers, and how a view of a field passes it on.

ColorFunction = Callable[[Tensor, Tensor], Tensor]
"""What :meth:`ColoredField.color` is."""


@runtime_checkable
class HasInverseDeviation(Protocol):
    """A field that may know how sharp its surface was when it was trained."""

    @property
    def inverse_deviation(self) -> float | None:
        """NeuS's s (Wang et al. 2021), per unit of the field's own frame; None where the field has none."""
        ...


@runtime_checkable
class ColoredField(SdfField, HasInverseDeviation, Protocol):
    """A field with color. A field without color has no attribute ``color``; :func:`has_color` tells it."""

    def color(self, points: Tensor, directions: Tensor) -> Tensor:
        """Color (N, 3) float32 in [0, 1], R, G, B, at points (N, 3) of the field's frame.

        directions: (N, 3), unit, of the field's frame, along the line of sight, away from the camera.
        """
        ...


def has_color(field: SdfField) -> TypeGuard[ColoredField]:
    return hasattr(field, "color")


def inverse_deviation_of(field: SdfField) -> float | None:
    """The inverse deviation of ``field``, per unit of its own frame; None where it has none."""
    return field.inverse_deviation if isinstance(field, HasInverseDeviation) else None


class OnDevice:
    """For dataclasses: ``to`` gives a copy with all that has a device, also within tuples, on another one."""

    def to(self, device: torch.device | str) -> Self:
        values = {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]
        return replace(self, **{name: _moved(value, device) for name, value in values.items()})  # type: ignore[type-var]


def _moved(value: Any, device: torch.device | str) -> Any:
    if isinstance(value, tuple):
        return tuple(_moved(one, device) for one in value)
    return value.to(device) if hasattr(value, "to") else value


@dataclass(frozen=True, eq=False)
class Observation:
    """A grid of cubic voxels, each UNSEEN, FREE or SURFACE (one was measured in it).

    states: (X, Y, Z) uint8 · low: (3,) float64, the grid's lowest corner · voxel: edge · T_grid_frame: from the frame
    that points are given in to the grid's; None: the same · of_thing: SURFACE is the surface of one thing
    alone, the one of a detection. Places where other surface was measured are UNSEEN.
    """

    states: Tensor
    low: Tensor
    voxel: float
    T_grid_frame: Sim3 | None = None
    of_thing: bool = False

    def at(self, points: Tensor) -> Tensor:
        """The states (N,) at points (N, 3) on the CPU; UNSEEN beyond the grid."""
        if self.T_grid_frame is not None:
            points = self.T_grid_frame.apply(points.double())
        cells = ((points - self.low.to(points)) / self.voxel).floor().long()
        counts = torch.tensor(self.states.shape)
        within = ((cells >= 0) & (cells < counts)).all(-1)
        x, y, z = cells.clamp_min(0).minimum(counts - 1).unbind(-1)
        return torch.where(within, self.states[x, y, z], UNSEEN)

    def measured_extent(self) -> Tensor | None:
        """(2, 3) float64: lowest and highest corner, in the points' frame, of a box that holds all voxels in which a
        surface was measured; None where there are none."""
        voxels = (self.states == SURFACE).nonzero()
        if len(voxels) == 0:
            return None
        ends = torch.stack([voxels.amin(0), voxels.amax(0) + 1]).double() * self.voxel + self.low.double()
        corners = torch.cartesian_prod(*ends.T)
        if self.T_grid_frame is not None:
            corners = self.T_grid_frame.apply_inverse(corners)
        return torch.stack([corners.amin(0), corners.amax(0)])

    def measured(self) -> Tensor:
        """(V, 3) float64: the middles of the voxels in which a surface was measured, in the points' frame."""
        points = ((self.states == SURFACE).nonzero().double() + 0.5) * self.voxel + self.low.double()
        return points if self.T_grid_frame is None else self.T_grid_frame.apply_inverse(points)

    def stored(self) -> tuple[ObservationGrid, NDArray[np.int32]]:
        """The grid and the tensor that a file keeps, both of the grid's own frame."""
        low, counts = self.low.tolist(), list(self.states.shape)
        grid = ObservationGrid((low[0], low[1], low[2]), self.voxel, (counts[0], counts[1], counts[2]))
        return grid, grid.pack(self.states.numpy())

    def without_shift(self) -> Observation:
        """The same with its grid in the points' frame, where they differ by a shift alone; else itself."""
        T = self.T_grid_frame
        if T is None or float(T.scale) != 1.0 or not torch.equal(T.rotation, torch.eye(3).to(T.rotation)):
            return self
        return replace(self, low=self.low - T.translation, T_grid_frame=None)

    def seen_in(self, T_frame_new: Sim3) -> Observation:
        """The same for points of a new frame, which ``T_frame_new`` carries to the present one."""
        T = T_frame_new if self.T_grid_frame is None else self.T_grid_frame @ T_frame_new
        return replace(self, T_grid_frame=T)


@runtime_checkable
class Observed(Protocol):
    """A field that may have an observation."""

    @property
    def observation(self) -> Observation | None:
        """In the field's own frame; None where it is not known."""
        ...


class FieldView:
    """A field seen through something: what a class does not say anew is the field's own."""

    color: ColorFunction
    """Only where the field has color."""

    def __init__(self, field: SdfField) -> None:
        self.field = field
        if has_color(field):
            self.color = self._color_of(field)

    def _color_of(self, field: ColoredField) -> ColorFunction:
        return field.color

    @property
    def bounds(self) -> Tensor:
        return self.field.bounds

    @property
    def device(self) -> torch.device:
        return self.field.device

    @property
    def observation(self) -> Observation | None:
        return observation_of(self.field)

    @property
    def inverse_deviation(self) -> float | None:
        return inverse_deviation_of(self.field)

    def signed_distance(self, points: Tensor) -> Tensor:
        return self.field.signed_distance(points)

    def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        return self.field.signed_distance_and_gradient(points)


class ObservedField(FieldView):
    """A field with another observation than its own; with None, one that nothing is known of."""

    def __init__(self, field: SdfField, observation: Observation | None) -> None:
        super().__init__(field)
        self._observation = observation

    @property
    def observation(self) -> Observation | None:
        return self._observation

    def native_model(self) -> NativeModel | None:
        """The field's own, where it has one: its values are those of this field."""
        return native_model(self.field)

    def to(self, device: torch.device | str) -> ObservedField:
        """The same field with its parameters on another device; the observation stays on the CPU."""
        return ObservedField(self.field.to(device), self._observation)


def stored_observation(grid: ObservationGrid, words: Tensor) -> Observation:
    """The observation that ``grid`` describes; ``words``: its tensor as stored."""
    states = torch.from_numpy(grid.unpack(words.cpu().numpy()))
    return Observation(states, torch.tensor(grid.low, dtype=torch.float64), grid.voxel)


def observation_of(field: SdfField) -> Observation | None:
    """The observation of ``field``, its own frame; None where there is none."""
    return field.observation if isinstance(field, Observed) else None


class CountingField(FieldView):
    """A field that counts the points at which it is evaluated. A value with its gradient counts as one evaluation.

    It has no color.
    """

    def __init__(self, field: SdfField) -> None:
        self.field = field
        self.evaluations = 0

    def native_model(self) -> NativeModel | None:
        """The field's own, whose points are counted."""
        found = native_model(self.field)
        return None if found is None else found.counting(self._count)

    def _count(self, points: int) -> None:
        self.evaluations += points

    def to(self, device: torch.device | str) -> CountingField:
        moved = CountingField(self.field.to(device))
        moved.evaluations = self.evaluations
        return moved

    def signed_distance(self, points: Tensor) -> Tensor:
        self.evaluations += points.shape[0]
        return self.field.signed_distance(points)

    def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        self.evaluations += points.shape[0]
        return self.field.signed_distance_and_gradient(points)
