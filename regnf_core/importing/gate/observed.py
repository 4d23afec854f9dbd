"""What was observed of a converted field, by what tells it: its own file, where its cameras stood, or its weights."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from regnf_core.errors import FieldFormatError, InvalidInputError
from regnf_core.fields.build import build_field
from regnf_core.fields.observation import SdfField
from regnf_core.importing.arrays import StoredArray
from regnf_core.importing.cost.mesh_work import Calls
from regnf_core.importing.families.converted import ConvertedField, observed_field
from regnf_core.importing.gate.cost_estimate import seconds_of
from regnf_core.importing.gate.plausibility import without_new_code
from regnf_core.importing.gate.reading import ReadUpload, with_unused_cameras
from regnf_core.importing.gate.report import ImportLimits
from regnf_core.importing.observing.by_weights import observed_by_weights
from regnf_core.importing.observing.trajectory import Array, Trajectory
from regnf_core.importing.upload_description import UploadDescription
from regnf_core.schema.description import OBSERVATION, ObservationGrid
from regnf_core.schema.safe_format import parse_description
from regnf_core.surface.observing import observe_by_cameras

_SHARE = 0.5
"""Of the seconds that the checks may take; as many again may go into this."""
_MOST_POINTS, _LEAST_POINTS = 5_000_000, 60_000
_ASKED = 1 << 14


def observed(converted: ConvertedField, read: ReadUpload, limits: ImportLimits, required: bool) -> ConvertedField:
    """The field with an observation, if anything tells. required: the caller has requested that of the cameras.

    An observation in the file stays, unless cameras were requested: it was made of the images, which know most, or as
    here. A map's own weights go before cameras: they know of depths that were missing, through which lines of sight
    would pass. Cameras found beside the file come last, if they can be used. Raises FieldFormatError as
    ``observed_by_cameras`` does, if ``required``.
    """
    if converted.description.get(OBSERVATION) is not None and (not required or read.cameras is None):
        return converted  # without cameras that are left, the import has used them
    found = observed_by_weights(converted.description, converted.tensors)
    if found is not None:
        if required:
            converted = with_unused_cameras(
                converted, "the observation is from the map's weights, which have more information"
            )
        return observed_field(converted, *found, "by the weights of the map")
    if read.cameras is None:
        return converted
    try:
        with without_new_code():
            grid, words, doubt = _observed_by_cameras(
                converted.description, converted.tensors, read.cameras, read.description, limits
            )
    except FieldFormatError as error:
        if required:
            raise
        return with_unused_cameras(converted, str(error))
    told = converted.warnings if doubt is None else (*converted.warnings, doubt)
    converted = replace(converted, warnings=told, assumes=(*converted.assumes, *read.cameras.assumes))
    return observed_field(converted, grid, words, f"by lines of sight from {len(read.cameras)} cameras")


def _observed_by_cameras(
    description: Mapping[str, Any],
    tensors: Mapping[str, StoredArray],
    trajectory: Trajectory,
    said: UploadDescription,
    limits: ImportLimits,
) -> tuple[ObservationGrid, npt.NDArray[np.int32], str | None]:
    """What the cameras saw of the field of ``description``, as its file keeps it, within an estimated time; a warning.

    Raises FieldFormatError: CAMERAS_OF_ANOTHER_FRAME, IMPORT_TOO_COSTLY, FIELD_NOT_FINITE.
    """
    own = {name: array for name, array in tensors.items() if name != OBSERVATION}
    points = _points(description, own, limits)
    field = _own_field(description, own)
    T_function_file = torch.from_numpy(_into_function(description, trajectory, said))
    others = [
        (f"{name}: {mend}", other.pinhole().moved(T_function_file)) for name, mend, other in trajectory.otherwise()
    ]
    try:
        seen, doubt = observe_by_cameras(field, trajectory.pinhole().moved(T_function_file), points, others)
    except InvalidInputError as error:
        raise FieldFormatError(str(error), reason=error.reason) from error
    return (*seen.stored(), doubt)


def _points(description: Mapping[str, Any], tensors: Mapping[str, StoredArray], limits: ImportLimits) -> int:
    """How many points may be evaluated. Raises FieldFormatError (IMPORT_TOO_COSTLY) for too few."""
    plain = {**description, OBSERVATION: None}
    asked = seconds_of(plain, tensors, Calls((_ASKED,), ()))
    points = int(min(_MOST_POINTS, _SHARE * limits.work_s * _ASKED / max(asked, 1e-9)))
    if points < _LEAST_POINTS and math.isfinite(limits.refused_beyond_s):
        message = f"lines of sight need at least {_LEAST_POINTS} evaluations; there is time for an estimated {points}"
        raise FieldFormatError(message, reason="IMPORT_TOO_COSTLY")
    return max(points, _LEAST_POINTS)


def _own_field(description: Mapping[str, Any], tensors: Mapping[str, StoredArray]) -> SdfField:
    """The field in the coordinates of its kind's function, which are those of an observation."""
    parsed = parse_description(dict(description))
    plain = replace(parsed, bounds=parsed.function_bounds, world_scale=1.0, placement=None, observation=None)
    return build_field(plain, {name: torch.from_numpy(np.ascontiguousarray(each)) for name, each in tensors.items()})


def _into_function(description: Mapping[str, Any], trajectory: Trajectory, said: UploadDescription) -> Array:
    """(4, 4), from the file's world to the function's coordinates.

    The file's cameras are in the dataset's frame where that is known, else in that of the field.
    """
    if said.dataset_transform is not None:
        known = np.linalg.inv(np.array(said.dataset_transform, np.float64))
        return known if trajectory.T_dataset_file is None else known @ trajectory.T_dataset_file
    scale = np.diag([1.0 / description["world_scale"]] * 3 + [1.0])
    placement = description.get("placement")
    if placement is None:
        return scale
    known = scale @ np.linalg.inv(np.array(placement["transform"], np.float64))
    return known if trajectory.T_dataset_file is None else known @ trajectory.T_dataset_file
