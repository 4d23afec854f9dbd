"""The detection: an oriented box in the scene's frame, in either of its two spellings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

from pydantic import Discriminator, Field, Tag, model_validator

from regnf_service.http.schemas.common import Coordinate, Incoming, Label
from regnf_service.jobs.boxes import IDENTITY, normal_quaternion

Point = Annotated[list[Coordinate], Field(min_length=3, max_length=3)]
Edge = Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)]
Component = Annotated[float, Field(ge=-1e3, le=1e3, allow_inf_nan=False)]
_LEAST_NORM_SQUARED = 1e-12


class _Labeled(Incoming):
    label: Label | None = Field(None, description="What the detector took it for. Not used by the registration.")
    score: Annotated[float, Field(ge=0, le=1)] | None = Field(None, description="The detector's confidence.")

    def _as_record(self, center: Sequence[float], size: Sequence[float], xyzw: Sequence[float]) -> dict[str, Any]:
        return {
            # adding zero turns -0.0 into 0.0: one value, one spelling
            "center": [float(value) + 0.0 for value in center],
            "size": [float(value) for value in size],
            "rotation_quaternion_xyzw": list(normal_quaternion(xyzw)),
            "label": self.label,
            "score": None if self.score is None else float(self.score),
        }


class CenteredDetection(_Labeled):
    """A box by center, full edge lengths and rotation (identity when left out), scene frame and units."""

    center: Point
    size: Annotated[list[Edge], Field(min_length=3, max_length=3)]
    rotation_quaternion_xyzw: Annotated[list[Component], Field(min_length=4, max_length=4)] = Field(list(IDENTITY))

    @model_validator(mode="after")
    def _rotates(self) -> CenteredDetection:
        if sum(value * value for value in self.rotation_quaternion_xyzw) < _LEAST_NORM_SQUARED:
            raise ValueError("rotation_quaternion_xyzw must not be zero")
        return self

    def canonical(self) -> dict[str, Any]:
        """The box as a job record holds it."""
        return self._as_record(self.center, self.size, self.rotation_quaternion_xyzw)


class CornerDetection(_Labeled):
    """An axis-aligned box by its lowest and its highest corner, scene frame and units."""

    min: Point
    max: Point

    @model_validator(mode="after")
    def _extends(self) -> CornerDetection:
        if not all(low < high for low, high in zip(self.min, self.max, strict=True)):
            raise ValueError("min must lie below max along every axis")
        return self

    def canonical(self) -> dict[str, Any]:
        """The same box by center and size."""
        corners = list(zip(self.min, self.max, strict=True))
        return self._as_record(
            [(low + high) / 2 for low, high in corners], [high - low for low, high in corners], IDENTITY
        )


def _spelling(value: Any) -> str:
    if isinstance(value, CornerDetection):
        return "corners"
    return "corners" if isinstance(value, dict) and value.keys() & {"min", "max"} else "centered"


Detection = Annotated[
    Annotated[CenteredDetection, Tag("centered")] | Annotated[CornerDetection, Tag("corners")], Discriminator(_spelling)
]
SPELLINGS = frozenset({"centered", "corners"})
