"""The detection: an oriented box in the scene's frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from regnf_core.detections import Detection, parse_detection
from regnf_core.detections.parsing import detection_of, open3d_names
from regnf_core.errors import InvalidDetectionError
from regnf_core.geometry.exponential_map import matrix_from_quaternion
from regnf_core.rotations import quaternion_of


@dataclass(frozen=True)
class OrientedBox:
    """A box with full edge lengths ``size`` about ``center``, its axes the columns of ``rotation``.

    center: (3,) scene frame, scene units · size: (3,) scene units, all > 0 · rotation: (3, 3), box axes to scene axes.
    All float64 on the CPU: a box is a handful of numbers, never a batch.
    """

    center: Tensor
    size: Tensor
    rotation: Tensor
    label: str | None = None
    score: float | None = None

    def __post_init__(self) -> None:
        for name, shape in (("center", (3,)), ("size", (3,)), ("rotation", (3, 3))):
            value = torch.as_tensor(getattr(self, name), dtype=torch.float64, device="cpu")
            if tuple(value.shape) != shape:
                raise InvalidDetectionError(f"box {name} has shape {tuple(value.shape)}, expected {shape}")
            if not torch.isfinite(value).all():
                raise InvalidDetectionError(f"box {name} holds a number that is not finite")
            object.__setattr__(self, name, value)
        if not (self.size > 0).all():
            raise InvalidDetectionError("box size must be positive along every axis")
        identity = torch.eye(3, dtype=torch.float64)
        if not torch.allclose(self.rotation @ self.rotation.T, identity, atol=1e-5) or torch.det(self.rotation) < 0:
            raise InvalidDetectionError("box rotation is not a rotation matrix")
        if self.score is not None and not 0.0 <= self.score <= 1.0:
            raise InvalidDetectionError("box score must be between 0 and 1")

    @classmethod
    def from_dict(cls, values: Any, index: int | None = None) -> OrientedBox:
        """A box from a detection's JSON, in any of the forms of :mod:`regnf_core.detections.parsing`.

        Raises InvalidDetectionError naming the faulty member and what to write instead.
        """
        return cls.from_detection(parse_detection(values, index))

    @classmethod
    def from_detection(cls, box: Detection) -> OrientedBox:
        return cls.from_quaternion(box.center, box.size, box.rotation_quaternion_xyzw, box.label, box.score)

    def to_detection(self) -> Detection:
        """The same box as plain numbers."""
        center, size = (tuple(values.tolist()) for values in (self.center, self.size))
        return Detection(center, size, quaternion_of(self.rotation.tolist()), self.label, self.score)

    @classmethod
    def from_corners(
        cls, lower: ArrayLike, upper: ArrayLike, label: str | None = None, score: float | None = None
    ) -> OrientedBox:
        """An axis-aligned box from its lowest and highest corner, (3,) each, scene frame."""
        low = torch.as_tensor(lower, dtype=torch.float64)
        high = torch.as_tensor(upper, dtype=torch.float64)
        if low.shape != (3,) or high.shape != (3,):  # a single number would spread over all axes
            raise InvalidDetectionError("each corner of a box needs three coordinates")
        return cls((low + high) / 2, high - low, torch.eye(3, dtype=torch.float64), label, score)

    @classmethod
    def from_center(
        cls,
        center: ArrayLike,
        size: ArrayLike,
        rotation: ArrayLike | None = None,
        label: str | None = None,
        score: float | None = None,
    ) -> OrientedBox:
        """A box from its center (3,), full edge lengths (3,) and axes: the columns of ``rotation`` (3, 3), scene frame.

        Without a rotation the box is axis-aligned. Raises InvalidDetectionError naming the faulty member.
        """
        said = {"center": center, "size": size, "rotation": rotation, "label": label, "score": score}
        return cls.from_dict({name: value for name, value in said.items() if value is not None})

    @classmethod
    def from_open3d(cls, box: Any, label: str | None = None, score: float | None = None) -> OrientedBox:
        """A box from Open3D's OrientedBoundingBox or AxisAlignedBoundingBox. Raises InvalidDetectionError."""
        if not open3d_names(box):
            hint = "Give an OrientedBoundingBox or an AxisAlignedBoundingBox; from_dict takes a detection's JSON."
            raise InvalidDetectionError(f"a {type(box).__name__} is not a box of Open3D", hint=hint)
        return cls.from_detection(replace(detection_of(box), label=label, score=score))

    @classmethod
    def from_quaternion(
        cls,
        center: Sequence[float],
        size: Sequence[float],
        rotation_quaternion_xyzw: Sequence[float] = (0.0, 0.0, 0.0, 1.0),
        label: str | None = None,
        score: float | None = None,
    ) -> OrientedBox:
        """A box from center (3,), full edge lengths (3,) and a quaternion (x, y, z, w) that need not be normalized."""
        q = torch.as_tensor(rotation_quaternion_xyzw, dtype=torch.float64)
        norm = q.norm()
        if q.shape != (4,) or not torch.isfinite(q).all() or norm < 1e-9:
            raise InvalidDetectionError("box rotation quaternion must be four finite numbers, not all zero")
        return cls(
            torch.as_tensor(center, dtype=torch.float64),
            torch.as_tensor(size, dtype=torch.float64),
            matrix_from_quaternion(q / norm),
            label,
            score,
        )

    def __repr__(self) -> str:
        center, size = ([float(f"{value:.4g}") for value in values.tolist()] for values in (self.center, self.size))
        turned = "" if torch.equal(self.rotation, torch.eye(3, dtype=torch.float64)) else ", turned"
        label = "" if self.label is None else f", {self.label!r}"
        return f"OrientedBox(center {center}, size {size}{turned}{label})"

    @property
    def diagonal(self) -> float:
        """Length of the space diagonal, scene units."""
        return float(self.size.norm())

    def corners(self) -> Tensor:
        """The eight corners, (8, 3), scene frame."""
        signs = torch.cartesian_prod(*[torch.tensor([-0.5, 0.5], dtype=torch.float64)] * 3)  # (8, 3)
        return self.center + (signs * self.size) @ self.rotation.T

    def shifted(self, shift: Tensor) -> OrientedBox:
        """The same box, ``shift`` (3,) farther."""
        return replace(self, center=self.center + shift)

    def to_local(self, points: Tensor) -> Tensor:
        """Points (N, 3) of the scene in the box's own frame: each coordinate within ±size/2 for points inside."""
        rotation = self.rotation.to(points)
        return (points - self.center.to(points)) @ rotation

    def contains(self, points: Tensor, margin: float = 0.0) -> Tensor:
        """(N,) bool: which points (N, 3), scene frame, lie in the box grown by ``margin`` (a share of its size)."""
        half = self.size.to(points) * (0.5 * (1.0 + margin))
        return (self.to_local(points).abs() <= half).all(dim=-1)


# Where rays enter and leave an axis-aligned box.


def ray_box_interval(origins: Tensor, directions: Tensor, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Entry (R,), at least 0, and exit (R,) of rays in multiples of their directions; exit <= entry: the ray misses.

    origins, directions: (R, 3), the directions of any length · low, high: (3,) corners; all in one frame and dtype.
    A ray that runs within a face counts as inside that face.
    """
    first, second = (low - origins) / directions, (high - origins) / directions
    # 0 / 0, a ray within a face: the face does not cut it off
    lowest = torch.minimum(first, second).nan_to_num(nan=-torch.inf, posinf=torch.inf, neginf=-torch.inf)
    highest = torch.maximum(first, second).nan_to_num(nan=torch.inf, posinf=torch.inf, neginf=-torch.inf)
    return lowest.amax(-1).clamp_min(0.0), highest.amin(-1)
