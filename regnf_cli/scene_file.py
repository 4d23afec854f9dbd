"""The scene's file: opened only once the box is known to lie in it, as far as the file's header tells."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from regnf_core.detections import Bounds, Detection, require_in_scene
from regnf_core.errors import InvalidDetectionError
from regnf_core.field_files import stored_bounds

if TYPE_CHECKING:
    from regnf_core.fields.base import SdfField


def check_box_by_header(scene: Path, box: Detection, obj: Path | None = None) -> None:
    """Refuse a box outside the scene before anything is opened; a checkpoint has no header that tells its bounds.

    Raises InvalidDetectionError naming the scene's file.
    """
    bounds = stored_bounds(scene)
    if bounds is not None:
        _require_in(scene, box, bounds, None if obj is None else stored_bounds(obj))


def open_scene(path: Path, box: Detection) -> SdfField:
    """The scene's field, refused as above by the bounds that only its import told."""
    from regnf_core.loading import load_field

    field = load_field(path)
    lower, upper = field.bounds.tolist()
    _require_in(path, box, (lower, upper), None)
    return field


def _require_in(path: Path, box: Detection, scene: Bounds, obj: Bounds | None) -> None:
    try:
        require_in_scene(box, scene, obj)
    except InvalidDetectionError as error:
        raise InvalidDetectionError(f"{path}: {error}", reason=error.reason, hint=error.hint) from error
