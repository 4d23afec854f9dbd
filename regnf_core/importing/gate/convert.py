"""The conversion itself, run in a throw-away process: ``python -m regnf_core.importing.gate.convert UPLOAD OUT_DIR``.

Standard input holds one JSON object {"description", "limits", "parent_pid", "picture"}; standard output gets one JSON
line: the report, or {"reason", "detail"}. The field is written to OUT_DIR/field.safetensors, a picture beside it.
"""

from __future__ import annotations

import contextlib
import errno
import json
import mmap
import os
import re
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from regnf_core.errors import FieldFormatError, RegnfError
from regnf_core.importing.containers.sniff import HEAD_BYTES, explain_refusal, sniff_format
from regnf_core.importing.containers.sniff_mesh import MESH_FORMATS
from regnf_core.importing.gate.picture import PICTURE_NAME
from regnf_core.importing.gate.report import ImportLimits
from regnf_core.importing.gate.sandbox import confine
from regnf_core.schema.kinds.voxel_grid import WEIGHTS
from regnf_core.schema.observation_grid import OBSERVATION

if TYPE_CHECKING:
    from regnf_core.fields.base import SdfField
    from regnf_core.importing.families.converted import ConvertedField

FIELD_NAME = "field.safetensors"
_SEEN = (OBSERVATION, WEIGHTS)
"""Tensors that say how much was seen; they are no parameters of the function."""
_ALL_ROUND = 0.95
_SIGN_UNCERTAIN = (
    "all round the bounds the values are negative: a room seen from within, or an object trained with its sign turned"
    " round; for the latter say sign -1"
)
_QUICK_S = 4.0
"""Processor seconds: a field that was evaluated more slowly than this is not drawn, which takes six times as long."""
_THREADED_FORMATS = ("ply", "pcd", "xyz", "off")
"""May be clouds of points; the library that reconstructs their surface cannot do without threads."""
_OUTPUT_ERRORS = {errno.EFBIG: "IMPORT_OUTPUT_TOO_LARGE", errno.ENOSPC: "STORAGE_FULL", errno.EDQUOT: "STORAGE_FULL"}


def convert_file(
    upload: Path, out_dir: Path, description: dict[str, Any] | None, limits: ImportLimits, picture: bool = False
) -> dict[str, Any]:
    """Convert ``upload``, write the safe field, evaluate it once, draw it if asked to. Returns the report's values.

    Confines nothing: the caller has done so. Raises FieldFormatError with the reason of the stage that refused.
    """
    from regnf_core.importing.gate.cost_estimate import require_affordable
    from regnf_core.schema.safe_format import write_safe_field

    converted = _convert(upload, description, limits)
    _require_text(converted.description)
    require_affordable(converted, limits)
    converted = _settled(converted)
    target = out_dir / FIELD_NAME
    write_safe_field(target, converted.description, converted.tensors)
    parameters = sum(array.size for name, array in converted.tensors.items() if name not in _SEEN)
    family, why, warnings = converted.family, converted.why, converted.warnings
    kind = str(converted.description["kind"])
    bounds, label = converted.description["bounds"], converted.description["label"]
    sign_is_open, up_axis = converted.sign_is_open, converted.description["up_axis"]
    del converted  # the tensors are on disk: let go of them before the evaluation
    # These load torch, which takes seconds and which a file that is refused above never needs.
    from regnf_core.fields.build import open_field
    from regnf_core.importing.gate.plausibility import check_plausibility

    field, started = open_field(target), time.process_time()
    measured, more = check_plausibility(field)
    if picture and time.process_time() - started < _QUICK_S:
        _draw(field, up_axis, out_dir / PICTURE_NAME)
    if sign_is_open and measured["share_inside_at_bounds"] > _ALL_ROUND:
        more.append(f"SIGN_UNCERTAIN: {_SIGN_UNCERTAIN}")
    return {
        "family": family,
        "kind": kind,
        "why": why,
        "bounds": bounds,
        "parameters": parameters,
        "plausibility": measured,
        "warnings": [*warnings, *more],
        "label": label,
    }


def _draw(field: SdfField, up_axis: str | None, path: Path) -> None:
    """A picture, if one can be made: it is not a condition of the import."""
    from regnf_core.importing.gate.plausibility import without_new_code
    from regnf_core.viewing.field_picture import field_picture

    with contextlib.suppress(RegnfError, MemoryError), without_new_code():
        field_picture(field, up_axis).save(path)


def _convert(upload: Path, description: dict[str, Any] | None, limits: ImportLimits) -> ConvertedField:
    from regnf_core.importing.containers.container import read_archive
    from regnf_core.importing.containers.legacy_container import read_legacy
    from regnf_core.importing.containers.npz import ArraySource
    from regnf_core.importing.families import convert_checkpoint
    from regnf_core.importing.families.arrays import convert_arrays
    from regnf_core.importing.families.safe_field import convert_safe_field
    from regnf_core.importing.pickle.pickle_reader import read_pickle
    from regnf_core.importing.tensor_source import TensorSource
    from regnf_core.importing.upload_description import UploadDescription

    overrides, tensor_bytes = UploadDescription.from_dict(description), limits.tensor_bytes
    data = _mapped(upload)
    head = bytes(data[:HEAD_BYTES])
    kind = sniff_format(head)
    if kind == "torch-zip":
        archive = read_archive(data)
        return convert_checkpoint(read_pickle(archive.read("data.pkl")), TensorSource(archive, tensor_bytes), overrides)
    if kind == "torch-legacy":
        values, legacy = read_legacy(data)
        return convert_checkpoint(values, TensorSource(legacy, tensor_bytes), overrides)
    if kind == "npz":
        return convert_arrays(ArraySource(data, tensor_bytes), overrides)
    if kind == "safetensors":
        return convert_safe_field(upload, data, tensor_bytes, overrides)
    if kind == "onnx":
        from regnf_core.importing.families.onnx import convert_onnx

        return convert_onnx(data, tensor_bytes, overrides)
    if kind == "sqlite":
        from regnf_core.importing.containers.sqlite_source import TableSource
        from regnf_core.importing.families.nvblox import convert_database

        return convert_database(TableSource(data), tensor_bytes, overrides)
    if kind in MESH_FORMATS:
        from regnf_core.importing.families.mesh import convert_mesh

        return convert_mesh(kind, data, overrides, limits.work_s)
    reason, detail = explain_refusal(head)
    raise FieldFormatError(detail, reason=reason)


def _require_text(description: dict[str, Any]) -> None:
    """JSON can spell lone surrogates, which no file can hold, and labels that hide what stands beside them.

    Raises FieldFormatError (SAFE_FORMAT_INVALID).
    """
    from regnf_core.labels import LABEL_PATTERN

    if not re.fullmatch(LABEL_PATTERN, description.get("label") or ""):
        raise FieldFormatError("the field's label has control characters", reason="SAFE_FORMAT_INVALID")
    try:
        json.dumps(description, ensure_ascii=False).encode("utf-8")
    except UnicodeEncodeError as error:
        raise FieldFormatError("the field's description is not Unicode text", reason="SAFE_FORMAT_INVALID") from error


def _settled(converted: ConvertedField) -> ConvertedField:
    """The one function that the field stands for, where its shapes leave several."""
    if converted.open_readings:
        from regnf_core.importing.gate.network_form import settle_form  # loads torch

        converted = settle_form(converted)
    if not converted.readings:
        return converted
    from regnf_core.importing.gate.choice import choose_reading  # loads torch

    return choose_reading(converted)


def _mapped(upload: Path) -> memoryview:
    with open(upload, "rb") as file:
        if os.fstat(file.fileno()).st_size == 0:
            return memoryview(b"")
        return memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))


def run(
    upload: Path, out_dir: Path, description: dict[str, Any] | None, limits: ImportLimits, picture: bool = False
) -> dict[str, Any]:
    """``convert_file``'s report, or {"reason", "detail"} for every foreseen way to fail."""
    try:
        return convert_file(upload, out_dir, description, limits, picture)
    except FieldFormatError as error:
        return {"reason": error.reason, "detail": str(error)}
    except MemoryError:
        return {"reason": "IMPORT_OUT_OF_MEMORY", "detail": "the conversion needs more memory than it may have"}
    except OSError as error:
        if error.errno == errno.ENOMEM:
            return {"reason": "IMPORT_OUT_OF_MEMORY", "detail": "the conversion needs more memory than it may have"}
        if error.errno not in _OUTPUT_ERRORS:
            raise
        return {"reason": _OUTPUT_ERRORS[error.errno], "detail": os.strerror(error.errno)}


def main(arguments: list[str]) -> int:
    """The process: confine, convert, report."""
    request = json.load(sys.stdin)
    limits = ImportLimits(**request["limits"])
    out_dir = Path(arguments[1])
    # Opened while all is still allowed: a folder on the way may be open to this process's privileges only.
    upload = os.open(arguments[0], os.O_RDONLY)
    threads = sniff_format(os.pread(upload, HEAD_BYTES, 0)) in _THREADED_FORMATS
    isolation = confine(limits, request["parent_pid"], upload, out_dir, threads)
    report = run(Path(f"/proc/self/fd/{upload}"), out_dir, request["description"], limits, request["picture"])
    report |= {"isolation": isolation, "peak_memory_bytes": _peak_memory()}
    sys.stdout.write(json.dumps(report, allow_nan=False) + "\n")
    sys.stdout.flush()
    return 0


def _peak_memory() -> int:
    """Largest resident size of this process, bytes, the touched part of the mapped upload included.

    Linux's own figure for this program image: getrusage would count what the parent held when it forked.
    """
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
