"""A field seen in another frame: the same surface after a similarity, distances in the other frame's units."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from regnf_core.fields.base import SdfField, field_repr
from regnf_core.fields.color import ColorFunction, color_in_frame, has_color, inverse_deviation_of
from regnf_core.fields.observation import Observation, observation_of
from regnf_core.geometry.sim3 import Sim3
from regnf_core.schema.similarity import local_origin


class TransformedField:
    """S_frame(x) = S_field(T x) / s for T = ``T_field_frame``, which carries the new frame's points to the field's own.

    The bounds are the axis-aligned box round the field's own bounds, in the new frame.
    """

    color: ColorFunction
    """Only where the field has color."""

    def __init__(self, field: SdfField, T_field_frame: Sim3) -> None:
        if isinstance(field, TransformedField):  # one transform in float64: two would lose the digits between them
            T_field_frame = field.T_field_frame @ T_field_frame
            field = field.field
        self.field: SdfField = field
        self.T_field_frame: Sim3 = T_field_frame
        if has_color(field):
            self.color = color_in_frame(field, T_field_frame)

    def __repr__(self) -> str:
        return field_repr(self)

    @property
    def bounds(self) -> Tensor:
        """(2, 3) float64 on the CPU, new frame."""
        low, high = self.field.bounds
        corners = torch.cartesian_prod(*torch.stack([low, high], dim=1))  # (8, 3)
        moved = self.T_field_frame.inverse().apply(corners)
        return torch.stack([moved.amin(0), moved.amax(0)])

    @property
    def device(self) -> torch.device:
        """That of the field."""
        return self.field.device

    @property
    def observation(self) -> Observation | None:
        """What was observed, new frame; None where it is not known."""
        seen = observation_of(self.field)
        return None if seen is None else seen.seen_in(self.T_field_frame)

    @property
    def inverse_deviation(self) -> float | None:
        """NeuS's s, per unit of the new frame; None where the field has none."""
        inverse = inverse_deviation_of(self.field)
        return None if inverse is None else inverse * float(self.T_field_frame.scale)

    def to(self, device: torch.device | str) -> TransformedField:
        """The same field with its parameters on another device."""
        return TransformedField(self.field.to(device), self.T_field_frame)

    def signed_distance(self, points: Tensor) -> Tensor:
        """Signed distance (N,) at points (N, 3) of the new frame, its units."""
        distance = self.field.signed_distance(self._moved(points))
        return distance / float(self.T_field_frame.scale)

    def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N,) and its gradient (N, 3) at points (N, 3) of the new frame."""
        distance, gradient = self.field.signed_distance_and_gradient(self._moved(points))
        return distance / float(self.T_field_frame.scale), gradient @ self.T_field_frame.rotation.to(gradient)

    def _moved(self, points: Tensor) -> Tensor:
        return self.T_field_frame.apply(points.double())


@runtime_checkable
class Movable(Protocol):
    """A field that can be moved itself, and loses nothing that a TransformedField would not pass on."""

    def moved(self, shift: Tensor) -> SdfField:
        """The same where ``shift`` (3,) float64 is subtracted from all places."""
        ...


def near_origin(field: SdfField) -> tuple[SdfField, Tensor]:
    """The field with its bounds near the origin, where float32 has digits enough, and what was subtracted.

    The second is (3,) float64 on the CPU, zeros where the field lies near the origin already, and is then returned
    itself.
    """
    origin = local_origin(field.bounds.tolist())
    if origin is None:
        return field, torch.zeros(3, dtype=torch.float64)
    shift = torch.tensor(origin, dtype=torch.float64)
    moved = field.moved(shift) if isinstance(field, Movable) else TransformedField(field, Sim3.from_translation(shift))
    return moved, shift
