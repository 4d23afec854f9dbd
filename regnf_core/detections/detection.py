"""A detection in its one form: center, full edge lengths, quaternion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from regnf_core.rotations import IDENTITY, Quaternion, Vector, normal_quaternion


@dataclass(frozen=True)
class Detection:
    """An oriented box as plain numbers, in the scene's frame and units.

    center: (x, y, z) · size: full edge lengths along the box's own axes, all > 0 · rotation_quaternion_xyzw: box axes
    to scene axes, not necessarily normalized. Made by :func:`parse_detection`, which checks every number.
    """

    center: Vector
    size: Vector
    rotation_quaternion_xyzw: Quaternion = IDENTITY
    label: str | None = None
    score: float | None = None

    def canonical(self) -> dict[str, Any]:
        """Plain values for job records: equal boxes have equal values, however they were written."""
        return {
            # adding zero turns -0.0 into 0.0
            "center": [value + 0.0 for value in self.center],
            "size": list(self.size),
            "rotation_quaternion_xyzw": list(normal_quaternion(self.rotation_quaternion_xyzw)),
            "label": self.label,
            "score": self.score,
        }
