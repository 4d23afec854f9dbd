"""Boxes as other libraries have them: read by their attributes, so that none of these is needed here."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from regnf_core.detections.detection import Detection
from regnf_core.detections.parsing import parse_detection
from regnf_core.errors import InvalidDetectionError

_ORIENTED = ("center", "extent", "R")
_ALIGNED = ("min_bound", "max_bound")


class HasDetection(Protocol):
    """A box of this library."""

    def to_detection(self) -> Detection: ...


class Open3DOrientedBox(Protocol):
    """Open3D's OrientedBoundingBox."""

    @property
    def center(self) -> Any: ...
    @property
    def extent(self) -> Any: ...
    @property
    def R(self) -> Any: ...  # noqa: N802 -- Open3D's name


class Open3DAlignedBox(Protocol):
    """Open3D's AxisAlignedBoundingBox."""

    @property
    def min_bound(self) -> Any: ...
    @property
    def max_bound(self) -> Any: ...


BoxLike = (
    HasDetection
    | Open3DOrientedBox
    | Open3DAlignedBox
    | Detection
    | Mapping[str, Any]
    | Sequence[Any]
    | os.PathLike[str]
)
"""A box, an Open3D box, a detection's JSON in any of its forms or its file's path, or a lowest and a highest corner."""


def detection_of(box: Any) -> Detection:
    """The detection that a box of any kind stands for. Raises InvalidDetectionError with what to write instead."""
    if isinstance(box, Detection):
        return box
    if callable(getattr(box, "to_detection", None)):
        found: Detection = box.to_detection()
        return found
    for names in (_ORIENTED, _ALIGNED):
        if _is_open3d(box, names):
            return parse_detection({name: getattr(box, name) for name in names})
    return parse_detection(box)


def open3d_detection(box: Any) -> Detection:
    """The same of an Open3D box alone. Raises InvalidDetectionError for anything else."""
    if isinstance(box, Mapping) or not any(
        all(hasattr(box, name) for name in names) for names in (_ORIENTED, _ALIGNED)
    ):
        hint = (
            "Give an OrientedBoundingBox or an AxisAlignedBoundingBox; OrientedBox.from_dict takes a detection's JSON."
        )
        raise InvalidDetectionError(f"a {type(box).__name__} is no box of Open3D", hint=hint)
    return detection_of(box)


def _is_open3d(box: Any, names: Sequence[str]) -> bool:
    return not isinstance(box, Mapping) and all(hasattr(box, name) for name in names)
