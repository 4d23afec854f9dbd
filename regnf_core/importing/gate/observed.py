"""What was observed of a converted field, by what tells it: its own file, where its cameras stood, or its weights."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from regnf_core.errors import FieldFormatError
from regnf_core.importing.families.converted import observed_field
from regnf_core.importing.gate.reading import with_unused_cameras
from regnf_core.schema.description import OBSERVATION

if TYPE_CHECKING:
    from regnf_core.importing.families.converted import ConvertedField
    from regnf_core.importing.gate.reading import ReadUpload
    from regnf_core.importing.gate.report import ImportLimits
    from regnf_core.importing.observing.trajectory import Trajectory


def observed(converted: ConvertedField, read: ReadUpload, limits: ImportLimits, required: bool) -> ConvertedField:
    """The field with an observation, if anything tells. required: the caller has asked for that of the cameras.

    An observation in the file stays, unless cameras were asked for: it was made of the images, which know most, or as
    here. A map's own weights go before cameras: they know of depths that were missing, through which lines of sight
    would pass. Cameras found beside the file come last, if they can be used. Raises FieldFormatError as
    ``observed_by_cameras`` does, if ``required``.
    """
    from regnf_core.importing.observing.by_weights import observed_by_weights

    if converted.description.get(OBSERVATION) is not None and not required:
        return converted
    found = observed_by_weights(converted.description, converted.tensors)
    if found is not None:
        if required:
            converted = with_unused_cameras(converted, "the map's weights say what was observed, and they tell more")
        return observed_field(converted, *found, "by the weights of the map")
    if read.cameras is None:
        return converted
    try:
        return _by_cameras(converted, read, read.cameras, limits)
    except FieldFormatError as error:
        if required:
            raise
        return with_unused_cameras(converted, str(error))


def _by_cameras(
    converted: ConvertedField, read: ReadUpload, cameras: Trajectory, limits: ImportLimits
) -> ConvertedField:
    from regnf_core.importing.gate.lines_of_sight import observed_by_cameras
    from regnf_core.importing.gate.plausibility import without_new_code

    with without_new_code():
        grid, words, doubt = observed_by_cameras(
            converted.description, converted.tensors, cameras, read.description, limits
        )
    if doubt is not None:
        converted = replace(converted, warnings=(*converted.warnings, doubt))
    return observed_field(converted, grid, words, f"by lines of sight from {len(cameras)} cameras")
