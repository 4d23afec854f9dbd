"""The work of an import, estimated before anything is evaluated, and the limit on it."""

from __future__ import annotations

from collections.abc import Mapping

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import StoredArray
from regnf_core.importing.cost.budget import require_room, require_within
from regnf_core.importing.cost.calls import SAMPLES, Calls, calls_of_check, calls_of_trials
from regnf_core.importing.cost.mesh_work import mesh_work
from regnf_core.importing.cost.network_work import network_work
from regnf_core.importing.cost.onnx_memory import onnx_bytes
from regnf_core.importing.cost.onnx_work import onnx_work
from regnf_core.importing.families.converted import ConvertedField, Reading
from regnf_core.importing.gate.report import ImportLimits
from regnf_core.schema.description import FieldDescription
from regnf_core.schema.kinds.mesh import MeshDescription
from regnf_core.schema.kinds.onnx import OnnxDescription
from regnf_core.schema.parsing import parse_description
from regnf_core.schema.safe_format import tensor_specs


def require_affordable(converted: ConvertedField, limits: ImportLimits) -> float:
    """The estimated seconds of one core for every evaluation of the import.

    Raises FieldFormatError: IMPORT_TOO_COSTLY beyond the limits on work and memory, and what the description is
    refused for.
    """
    readings = converted.readings
    if readings:
        trials = calls_of_trials(len(readings))
        seconds = max(_seconds_of_reading(reading, trials) for reading in readings)
        seconds += max(_seconds_of_reading(reading, calls_of_check(SAMPLES)) for reading in readings)
    else:
        seconds = seconds_of(converted.description, converted.tensors, calls_of_check(SAMPLES))
    require_within(seconds, limits.work_s)
    description = parse_description(converted.description)
    if isinstance(description, OnnxDescription):
        require_room(onnx_bytes(description, converted.tensors), limits.memory_bytes)
    return seconds


def _seconds_of_reading(reading: Reading, calls: Calls) -> float:
    """A reading that is no field costs nothing: it is passed over when the readings are tried."""
    try:
        return seconds_of(reading.description, reading.tensors, calls)
    except FieldFormatError:
        return 0.0


def seconds_of(description: dict[str, object], tensors: Mapping[str, StoredArray], calls: Calls) -> float:
    """Estimated seconds of one core for these calls. Raises what a faulty description is refused for."""
    parsed = parse_description(description)
    parsed.check(tensor_specs(tensors))
    return _work(parsed, tensors, calls)


def _work(description: FieldDescription, tensors: Mapping[str, StoredArray], calls: Calls) -> float:
    match description:
        case OnnxDescription():
            return onnx_work(description, tensors, calls)
        case MeshDescription():
            return mesh_work(tensors["vertices"], tensors["faces"], calls)
    return network_work(description, tensors, calls)
