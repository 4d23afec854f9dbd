"""What a field with color offers, and how a view of a field passes it on."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Protocol, TypeGuard, runtime_checkable

from torch import Tensor

from regnf_core.fields.base import SdfField
from regnf_core.geometry.sim3 import Sim3

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
    """Whether ``field`` has a color."""
    return hasattr(field, "color")


def inverse_deviation_of(field: SdfField) -> float | None:
    """The inverse deviation of ``field``, per unit of its own frame; None where it has none."""
    return field.inverse_deviation if isinstance(field, HasInverseDeviation) else None


def color_in_frame(field: ColoredField, T_field_frame: Sim3) -> ColorFunction:
    """The color of ``field`` for points and directions of another frame, which T_field_frame takes to the field's."""
    return partial(_color_in_frame, field, T_field_frame)


def color_in_unit(field: ColoredField, scale: float) -> ColorFunction:
    """The color of ``field`` for points in a unit, of which ``scale`` make up one unit of the field's coordinates."""
    return partial(_color_in_unit, field, scale)


def _color_in_frame(field: ColoredField, T_field_frame: Sim3, points: Tensor, directions: Tensor) -> Tensor:
    moved = T_field_frame.apply(points.double())
    return field.color(moved, directions @ T_field_frame.rotation.to(directions).T).float()


def _color_in_unit(field: ColoredField, scale: float, points: Tensor, directions: Tensor) -> Tensor:
    return field.color(points / scale, directions)
