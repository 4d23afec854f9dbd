"""Models of objects that are files: made once a file, kept in the user's cache."""

from __future__ import annotations

import hashlib
from pathlib import Path

from regnf_core.errors import FieldFormatError
from regnf_core.field_source import FieldSource
from regnf_core.fields.build import open_field
from regnf_core.library import ObjectModel, model_object, read_object_model, write_object_model
from regnf_core.loading import default_cache_dir, safe_field
from regnf_core.options import RobustOptions
from regnf_core.version import ENGINE_REVISION


def object_model(source: FieldSource, options: RobustOptions) -> ObjectModel:
    """The model of an object; one by default options is kept, and made again where it does not read.

    Raises NoSurfaceError, and FieldFormatError naming the file.
    """
    field = safe_field(source).path
    kept = _place(field) if options.object_samples == RobustOptions().object_samples else None
    if kept is not None:
        try:
            return read_object_model(kept)
        except FieldFormatError:
            pass  # not made yet, by another version, or damaged
    model = model_object(open_field(field), options)
    if kept is not None:
        kept.parent.mkdir(parents=True, exist_ok=True)
        write_object_model(kept, model)
        return read_object_model(kept)  # the first search finds what all others will
    return model


def _place(safe_field: Path) -> Path:
    with safe_field.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return default_cache_dir().parent / "object-models" / f"{digest}-{ENGINE_REVISION}.safetensors"
