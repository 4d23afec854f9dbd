"""Fields that are made of several: whose matter is at a point."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from torch import Tensor

from regnf_core.fields.base import SdfField
from regnf_core.geometry.sim3 import Sim3

SCENE_PART = 0
Tint = tuple[float, float, float]
"""sRGB, each 0..1."""


@dataclass(frozen=True, eq=False)
class Part:
    """One of the fields. T_field_scene: from the edited scene's frame to the field's own; None: the same · tint: what
    it is colored with, None: its own colors · name: for people."""

    field: SdfField
    T_field_scene: Sim3 | None
    tint: Tint | None = None
    name: str | None = None


@runtime_checkable
class PartedField(Protocol):
    """A field that knows which of its parts a point belongs to."""

    @property
    def parts(self) -> tuple[Part, ...]:
        """The scene, then an edit's object each; an edit that has none (a removal) has the scene's field."""
        ...

    def part_at(self, points: Tensor) -> Tensor:
        """(N,) int64, which part's surface is nearest to points (N, 3)."""
        ...

    def signed_distance_and_part(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N,) at points (N, 3), and which part's surface is nearest (N,) int64."""
        ...
