"""Scenes that are recordings: what an import makes of one, and the place in it where a job looks for its object."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from regnf_core.errors import DatasetError
from regnf_state.registration_request import RegistrationRequest

if TYPE_CHECKING:
    from regnf_fit.images.place import Place


def place_of(scene: Path, request: RegistrationRequest, obj: Any, device: str) -> Place:
    """The place that a request is about. obj: the object's model or field; None: there are several.

    Raises RegnfError: those of a field's file, DatasetError and InvalidDetectionError, naming the frame.
    """
    from regnf_core.fields.build import open_field
    from regnf_data.recordings.stored import is_stored, read_stored
    from regnf_fit.images.place import place_in

    if not is_stored(scene):
        return place_in(open_field(scene, device), request.detection, None, request.options)
    held = read_stored(scene, "the recording")
    found = place_in(held, request.detection, None if obj is None else obj.bounds, request.options)
    return replace(found, field=found.field.to(device))


def joined_recordings(first: Path, added: Path, name: str, target: Path) -> None:
    """Write a stored recording of the frames of ``first`` and the only one of ``added``, which gets this name.

    Raises DatasetError (DATASET_FRAMES_INVALID) where a frame has the name already, or is of another size.
    """
    from regnf_data.recordings.stored import read_stored, write_recording

    held, one = read_stored(first, "the recording"), read_stored(added, name)
    if any(frame.name == name for frame in held.frames):
        raise DatasetError(f"the recording already has a frame {name}", reason="DATASET_FRAMES_INVALID")
    whole = replace(held, frames=(*held.frames, replace(one.frames[0], name=name)))
    if len(write_recording(whole, range(len(whole)), target)["frames"]) < len(whole):
        message = f"frame {name} has another size than the previous frames"
        raise DatasetError(message, reason="DATASET_SIZES_DIFFER")


def joined_reports(first: Mapping[str, Any], added: Mapping[str, Any], name: str) -> dict[str, Any]:
    """What is known of such a recording."""
    corners = zip(first["bounds"], added["bounds"], (min, max), strict=True)
    bounds = [list(map(choose, a, b)) for a, b, choose in corners]
    return {**first, "bounds": bounds, "frames": [*first["frames"], name]}
