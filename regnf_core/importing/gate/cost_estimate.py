"""The work of an import, estimated before anything is evaluated, and the limit on it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import StoredArray
from regnf_core.importing.cost.mesh_work import (
    COLOR_POINTS,
    SAMPLES,
    SHARES,
    Calls,
    calls_of_check,
    calls_of_trials,
    color_work,
    free_room,
    mesh_work,
    network_work,
    require_room,
    require_within,
)
from regnf_core.importing.families.color.head import ASSUMED, LEFT_OUT
from regnf_core.importing.families.converted import ConvertedField, Reading
from regnf_core.importing.gate.report import ImportLimits
from regnf_core.schema.description import COLOR, FieldDescription, NetworkColor, split_color
from regnf_core.schema.kinds import MeshDescription, OnnxDescription
from regnf_core.schema.safe_format import parse_description, tensor_specs


def require_affordable(converted: ConvertedField, limits: ImportLimits) -> float:
    """The estimated seconds of one core for every evaluation of the import.

    Raises FieldFormatError: IMPORT_TOO_COSTLY beyond the limits on work and memory, and what the description is
    refused for.
    """
    description = parse_description(converted.description)
    if isinstance(description, OnnxDescription):
        most, room = limits.refused_beyond_s, free_room(limits.memory_bytes)
        seconds, size = _onnx_needs(description, converted.tensors, calls_of_check(SAMPLES), most, room)
        require_within(seconds, most)
        require_room(size, room)
        return seconds
    if converted.readings:
        seconds = _share_and_seconds(converted.readings, limits)[1]
    else:
        seconds = seconds_of(converted.description, converted.tensors, calls_of_check(SAMPLES))
    require_within(seconds, limits.refused_beyond_s)
    return seconds


def with_affordable_color(converted: ConvertedField, limits: ImportLimits) -> ConvertedField:
    """``converted``; without its color, and with a warning, where that would take longer than all checks may."""
    color = parse_description(converted.description).color
    if not isinstance(color, NetworkColor):
        return converted
    seconds = seconds_of(converted.description, converted.tensors, Calls((), (COLOR_POINTS,)))
    seconds += COLOR_POINTS * color_work(color, converted.tensors)
    if seconds <= limits.work_s:
        return converted
    told = (
        f"{COLOR_POINTS} points would take an estimated {seconds:.0f} s of processor time; {limits.work_s:g} s are"
        f" allowed"
    )
    return replace(
        converted,
        description={name: value for name, value in converted.description.items() if name != COLOR},
        tensors=split_color(converted.tensors)[0],
        warnings=(*(said for said in converted.warnings if not said.startswith(ASSUMED)), f"{LEFT_OUT}: {told}"),
    )


def affordable_share(converted: ConvertedField, limits: ImportLimits) -> int:
    """One of how many parts of the points the readings can be tried at within the limit on work."""
    return _share_and_seconds(converted.readings, limits)[0]


def _share_and_seconds(readings: Sequence[Reading], limits: ImportLimits) -> tuple[int, float]:
    """The largest affordable part of the points, and the seconds of trials at them and of the check of one reading."""
    fields = tuple(_fields_of(readings))
    checked = max((_work(parsed, tensors, calls_of_check(SAMPLES)) for parsed, tensors in fields), default=0.0)
    seconds = 0.0
    for share in SHARES:
        trials = calls_of_trials(len(readings), share)
        seconds = checked + max((_work(parsed, tensors, trials) for parsed, tensors in fields), default=0.0)
        if seconds <= limits.work_s:
            return share, seconds
    return SHARES[-1], seconds


def _fields_of(readings: Sequence[Reading]) -> Iterator[tuple[FieldDescription, Mapping[str, StoredArray]]]:
    """A reading that is no field costs nothing: it is passed over when the readings are tried."""
    for reading in readings:
        with suppress(FieldFormatError):
            yield _checked(reading.description, reading.tensors), reading.tensors


def seconds_of(description: dict[str, object], tensors: Mapping[str, StoredArray], calls: Calls) -> float:
    """Estimated seconds of one core for these calls. Raises what a faulty description is refused for."""
    return _work(_checked(description, tensors), tensors, calls)


def _checked(description: dict[str, object], tensors: Mapping[str, StoredArray]) -> FieldDescription:
    parsed = parse_description(description)
    parsed.check(tensor_specs(tensors))
    return parsed


def _work(description: FieldDescription, tensors: Mapping[str, StoredArray], calls: Calls) -> float:
    match description:
        case OnnxDescription():
            return _onnx_needs(description, tensors, calls)[0]
        case MeshDescription():
            return mesh_work(tensors["vertices"], tensors["faces"], calls)
    return network_work(description, tensors, calls)


def _onnx_needs(
    description: OnnxDescription,
    tensors: Mapping[str, StoredArray],
    calls: Calls,
    most_s: float = math.inf,
    most_bytes: float = math.inf,
) -> tuple[float, int]:
    # These load torch, which a file that is refused before never needs.
    from regnf_core.importing.cost.onnx_work import onnx_needs
    from regnf_core.importing.gate.plausibility import without_new_code

    with without_new_code():
        return onnx_needs(description, tensors, calls, most_s, most_bytes)
