"""Fields seen in another frame: moved, turned and scaled, or near the origin."""

from __future__ import annotations

from functools import partial
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from regnf_core.fields.observation import (
    ColoredField,
    ColorFunction,
    FieldView,
    Observation,
    SdfField,
    field_repr,
    inverse_deviation_of,
    observation_of,
)
from regnf_core.geometry.sim3 import Sim3
from regnf_core.native.steps import NativeModel, native_model
from regnf_core.schema.similarity import local_origin


@runtime_checkable
class SurfaceSource(Protocol):
    """A field that knows points of its own surface."""

    @property
    def area(self) -> float:
        """Area of the surface, own units squared."""
        ...

    def sample_surface(self, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
        """``count`` points (count, 3), uniform over the surface's area."""
        ...


# A field seen in another frame: the same surface after a similarity, distances in the other frame's units.


class TransformedField(FieldView):
    """S_frame(x) = S_field(T x) / s for T = ``T_field_frame``, which carries the new frame's points to the field's own.

    The bounds are the axis-aligned box around the field's own bounds, in the new frame.
    """

    def __init__(self, field: SdfField, T_field_frame: Sim3) -> None:
        if isinstance(field, TransformedField):  # one transform in float64: two would lose the digits between them
            T_field_frame = field.T_field_frame @ T_field_frame
            field = field.field
        self.T_field_frame: Sim3 = T_field_frame
        super().__init__(field)

    def _color_of(self, field: ColoredField) -> ColorFunction:
        return partial(_color_in_frame, field, self.T_field_frame)

    def __repr__(self) -> str:
        return field_repr(self)

    @property
    def bounds(self) -> Tensor:
        low, high = self.field.bounds
        corners = torch.cartesian_prod(*torch.stack([low, high], dim=1))  # (8, 3)
        moved = self.T_field_frame.apply_inverse(corners)
        return torch.stack([moved.amin(0), moved.amax(0)])

    @property
    def observation(self) -> Observation | None:
        seen = observation_of(self.field)
        return None if seen is None else seen.seen_in(self.T_field_frame)

    @property
    def inverse_deviation(self) -> float | None:
        inverse = inverse_deviation_of(self.field)
        return None if inverse is None else inverse * float(self.T_field_frame.scale)

    def native_model(self) -> NativeModel | None:
        """For compiled code, where the field has such."""
        found, T = native_model(self.field), self.T_field_frame.on("cpu")
        if found is None or any(part.requires_grad for part in (T.scale, T.rotation, T.translation)):
            return None
        scale = float(T.scale)
        return found.seen_by(scale * T.rotation.numpy(), T.translation.numpy(), 1.0 / scale)

    def to(self, device: torch.device | str) -> TransformedField:
        return TransformedField(self.field.to(device), self.T_field_frame)

    def signed_distance(self, points: Tensor) -> Tensor:
        distance = self.field.signed_distance(self.T_field_frame.apply(points.double()))
        return distance / float(self.T_field_frame.scale)

    def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        distance, gradient = self.field.signed_distance_and_gradient(self.T_field_frame.apply(points.double()))
        return distance / float(self.T_field_frame.scale), gradient @ self.T_field_frame.rotation.to(gradient)


def _color_in_frame(field: ColoredField, T_field_frame: Sim3, points: Tensor, directions: Tensor) -> Tensor:
    moved = T_field_frame.apply(points.double())
    return field.color(moved, directions @ T_field_frame.rotation.to(directions).T).float()


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
