"""What both presets require before they register: a box that meets the scene, and enough surface."""

from __future__ import annotations

from regnf_core.detections import require_in_scene
from regnf_core.errors import NoSurfaceError
from regnf_core.fields.observation import SdfField
from regnf_core.geometry.box import OrientedBox

MIN_POINTS = 50
"""Fewest surface points, of the scene in the box and of the object, that a registration starts with."""


def require_box_in_scene(scene: SdfField, detection: OrientedBox) -> None:
    """Raises InvalidDetectionError (DETECTION_OUTSIDE_SCENE) when the box lies wholly outside the scene's bounds."""
    low, high = scene.bounds.tolist()
    require_in_scene(detection.to_detection(), (low, high))


def require_surface(points: int, of_object: bool) -> None:
    """Raises NoSurfaceError (NO_SURFACE_IN_DETECTION, NO_SURFACE_IN_OBJECT) for fewer than MIN_POINTS points."""
    if points < MIN_POINTS:
        where, what = ("on the object", "OBJECT") if of_object else ("in the detection box", "DETECTION")
        raise NoSurfaceError(f"only {points} surface points {where}", reason=f"NO_SURFACE_IN_{what}")
