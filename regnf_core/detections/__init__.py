"""Detections: the box in which an object was found, in the forms that detectors and datasets write.

Torch-free: the command line and the HTTP interface check a box before any field is opened.
"""

from __future__ import annotations

from regnf_core.detections.bounds import Bounds, Detection, require_in_scene
from regnf_core.detections.parsing import parse_detection

__all__ = ["Bounds", "Detection", "parse_detection", "require_in_scene"]
