"""The scene's file: opened only once the box is known to lie in it, as far as the file's header tells."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from regnf_core.detections import Bounds, Detection, require_in_scene
from regnf_core.errors import InvalidDetectionError
from regnf_core.field_files import stored_bounds
from regnf_core.field_source import FieldSource

if TYPE_CHECKING:
    from regnf_core.loading import LoadedField


def check_box_by_header(scene: Path, box: Detection, obj: Path | None = None) -> None:
    """Refuse a box outside the scene before anything is opened; a checkpoint has no header that tells its bounds.

    Raises InvalidDetectionError naming the scene's file.
    """
    bounds = stored_bounds(scene)
    if bounds is not None:
        _require_in(scene, box, bounds, None if obj is None else stored_bounds(obj))


def open_scene(source: FieldSource, box: Detection) -> LoadedField:
    """The scene's field, refused as above by the bounds that only its import told."""
    from regnf_core.loading import load_field

    loaded = load_field(source)
    lower, upper = loaded.field.bounds.tolist()
    _require_in(source.named, box, (lower, upper), None)
    return loaded


def _require_in(path: Path, box: Detection, scene: Bounds, obj: Bounds | None) -> None:
    try:
        require_in_scene(box, scene, obj)
    except InvalidDetectionError as error:
        raise InvalidDetectionError(f"{path}: {error}", reason=error.reason, hint=error.hint) from error
