"""The conversion itself, run in a throw-away process:
``python -m regnf_core.importing.gate.convert OUT_DIR UPLOAD [SETTINGS] [CAMERAS]``.

Standard input holds one JSON object {"description", "limits", "parent_pid", "picture", "ask_by_picture", "settings",
"cameras"}, the last two the names of those files or null; standard output gets one JSON line: the report, or {"reason",
"detail"} and perhaps "candidates". The field is written to OUT_DIR/field.safetensors, a picture beside it; pictures of
candidates too.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import re
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from regnf_core.errors import FieldFormatError, RegnfError
from regnf_core.field_notes import ASSUMED, WARNINGS, kept_warnings
from regnf_core.importing.containers.sniff import (
    GAUSSIANS,
    HEAD_BYTES,
    MARKED_BYTES,
    RUN_ARCHIVES,
    SPLAT_FORMATS,
    sniff_format,
)
from regnf_core.importing.cost.mesh_work import Calls
from regnf_core.importing.families.converted import AmbiguousError, untold_error
from regnf_core.importing.gate.picture import PICTURE_NAME, candidate_name
from regnf_core.importing.gate.reading import Companions
from regnf_core.importing.gate.report import ImportLimits
from regnf_core.importing.gate.sandbox import confine
from regnf_core.schema.description import OBSERVATION, split_color
from regnf_core.schema.kinds import WEIGHTS

if TYPE_CHECKING:
    from regnf_core.importing.families.converted import OpenCandidate
    from regnf_core.importing.gate.reading import ReadUpload

FIELD_NAME = "field.safetensors"
_ROOM = 32 << 10
"""Bytes in the field file for the warnings, which are known once it is evaluated."""
_SEEN = (OBSERVATION, WEIGHTS)
"""Tensors that say how much was seen; they are no parameters of the function."""
_ALL_ROUND = 0.95
_SIGN_UNCERTAIN = (
    "the values are negative everywhere at the bounds: it is a room seen from inside, or an object with inverted "
    "sign; for the latter give the import option sign: -1"
)
_QUICK_S = 4.0
"""Processor seconds: a field that was evaluated more slowly than this is not drawn, which takes six times as long."""
_PICTURES_S, _PICTURES_SHARE = 20.0, 0.25
"""Seconds for the pictures of what is asked, and the most of what is left of the import's time."""
_SMALL_PICTURE = Calls((40_000, 37_000), (12_000,))
"""About as many points as a small picture takes."""
_THREADED_FORMATS = RUN_ARCHIVES | {"e57", "las", "npy", "pcd", "ply", "xyz", "instant-ngp", *SPLAT_FORMATS}
"""May be, or hold, clouds of points, Gaussian splats or radiance fields; the library that makes their surface needs
threads."""
_THREADED_MARKS = (GAUSSIANS, b"gauss_params", b"field.mlp_base")
"""What stands near the beginning of other files with Gaussian splats or radiance fields: glTF files, checkpoints."""
_OUTPUT_ERRORS = {errno.EFBIG: "IMPORT_OUTPUT_TOO_LARGE", errno.ENOSPC: "STORAGE_FULL", errno.EDQUOT: "STORAGE_FULL"}


def convert_file(
    upload: Path,
    out_dir: Path,
    description: dict[str, Any] | None,
    limits: ImportLimits,
    picture: bool = False,
    beside: Companions | None = None,
) -> dict[str, Any]:
    """Convert ``upload``, write the regnf field file, evaluate it once, draw it if asked to. Returns the report's
    values.

    beside: what came with it, each the name and the path of one file or of an archive of files. Confines nothing: the
    caller has done so. Raises FieldFormatError with the reason of the stage that refused.
    """
    from regnf_core.schema.safe_format import add_to_source

    read = _read(upload, out_dir, description, limits, beside or Companions())
    target, said = out_dir / FIELD_NAME, read.description
    cameras = beside is not None and beside.cameras is not None
    # What is kept of the field: its tensors are let go of before the evaluation.
    reported, warnings, sign, sign_is_open, up_axis = _stored(read, target, limits, cameras)
    measured, more, surface = _evaluated(
        target, reported["kind"] == "mesh", picture, up_axis, bool(said.accept_implausible), sign
    )
    if sign_is_open and measured["share_inside_at_bounds"] > _ALL_ROUND:
        more.append(f"SIGN_UNCERTAIN: {_SIGN_UNCERTAIN}")
    # Of warnings with the same word the last: a regnf field file brings those of its first import.
    latest = {warning.partition(":")[0]: warning for warning in (*warnings, *more)}
    warned = list(kept_warnings(list(latest.values())))
    notes = {WARNINGS: warned, ASSUMED: reported[ASSUMED]}
    add_to_source(target, {name: lines for name, lines in notes.items() if lines})
    told = {"plausibility": measured, "surface_bounds": surface, "warnings": warned, "settings": read.settings}
    return {**reported, **told}


def _stored(
    read: ReadUpload, target: Path, limits: ImportLimits, cameras: bool
) -> tuple[dict[str, Any], Sequence[str], int | None, bool, str | None]:
    """Write the regnf field file of what was read to ``target``. cameras: whether they came with it.

    Returns values of the report, warnings, the sign where nobody has said it, whether the values will tell it, and the
    up axis. Raises FieldFormatError.
    """
    from regnf_core.importing.assumptions import left_open
    from regnf_core.importing.families import safe_field
    from regnf_core.importing.gate.cost_estimate import affordable_share, require_affordable, with_affordable_color
    from regnf_core.importing.gate.observed import observed
    from regnf_core.importing.gate.report import placed
    from regnf_core.schema.safe_format import write_safe_field

    _require_text(read.field.description)
    require_affordable(read.field, limits)
    converted = read.field
    if converted.readings or converted.assumed:
        from regnf_core.importing.gate.choice import settled  # loads torch

        converted = settled(converted, affordable_share(converted, limits))
    if converted.untold:
        what = "neither the tensors nor the values of the field determine which function this is"
        raise untold_error(converted, converted.untold, what)
    converted = placed(with_affordable_color(converted, limits), read.description)
    converted = observed(converted, read, limits, required=cameras)
    said = converted.description
    write_safe_field(target, said, converted.tensors, _ROOM)
    own, _ = split_color(converted.tensors)
    reported = {
        "family": converted.family,
        "kind": str(said["kind"]),
        "why": converted.why,
        "bounds": said["bounds"],
        "parameters": sum(array.size for name, array in own.items() if name not in _SEEN),
        "label": said["label"],
        ASSUMED: list(left_open(converted.assumes, read.description)),
    }
    # A mesh's faces say it, and a regnf field file was imported before.
    known = (
        read.description.sign or read.description.as_ or said["kind"] == "mesh" or converted.family == safe_field.FAMILY
    )
    return reported, converted.warnings, None if known else int(said["sign"]), converted.sign_is_open, said["up_axis"]


def _read(
    upload: Path, out_dir: Path, description: dict[str, Any] | None, limits: ImportLimits, beside: Companions
) -> ReadUpload:
    """What ``read_upload`` returns; nothing that it has unpacked is left, but what is mapped stays readable."""
    from regnf_core.importing.gate.reading import read_upload
    from regnf_core.importing.run.tar_run import remove_unpacked

    try:
        return read_upload(upload, out_dir, description, limits, beside)
    finally:
        remove_unpacked(out_dir)


def _evaluated(
    path: Path, is_mesh: bool, picture: bool, up_axis: str | None, accept_implausible: bool, sign: int | None
) -> tuple[dict[str, float], list[str], list[list[float]]]:
    """What ``check_plausibility`` tells of the field in the file ``path``; if that is quick, a picture of it beside it.

    sign: see ``require_plausible``. Raises FieldFormatError.
    """
    # These load torch, which takes seconds and which a file that is refused before never needs.
    from regnf_core.fields.build import open_field
    from regnf_core.importing.gate.plausibility import check_plausibility, require_plausible, without_new_code

    field, started = open_field(path), time.process_time()
    measured, warnings, surface = check_plausibility(field, is_mesh=is_mesh)
    if not accept_implausible:
        require_plausible(measured, sign)
    if picture and time.process_time() - started < _QUICK_S:
        from regnf_core.viewing.field_picture import field_picture

        # It is not a condition of the import.
        with without_new_code(), contextlib.suppress(RegnfError, MemoryError):
            field_picture(field, up_axis).save(path.with_name(PICTURE_NAME))
    return measured, warnings, surface


def _require_text(description: dict[str, Any]) -> None:
    """JSON can spell lone surrogates, which no file can hold, and labels that hide what stands beside them.

    Raises FieldFormatError (SAFE_FORMAT_INVALID).
    """
    from regnf_core.library_entries import LABEL_PATTERN

    if not re.fullmatch(LABEL_PATTERN, description.get("label") or ""):
        raise FieldFormatError("the label of the field has control characters", reason="SAFE_FORMAT_INVALID")
    try:
        json.dumps(description, ensure_ascii=False).encode("utf-8")
    except UnicodeEncodeError as error:
        raise FieldFormatError(
            "the description of the field is not Unicode text", reason="SAFE_FORMAT_INVALID"
        ) from error


def draw_asked(asked: Sequence[OpenCandidate], out_dir: Path, seconds: float) -> None:
    """A picture of each function that a person is asked about, in so many processor seconds: as many as there can be.

    The refusal does without those that cannot be drawn. torch lacks memory with a RuntimeError.
    """
    from regnf_core.importing.gate.cost_estimate import seconds_of
    from regnf_core.importing.gate.evidence import field_of
    from regnf_core.importing.gate.plausibility import without_new_code
    from regnf_core.viewing.field_picture import SMALL, field_picture

    deadline = time.process_time() + seconds

    def look(_: int) -> None:
        if time.process_time() > deadline:
            raise RegnfError("there is no time left for the picture")

    for number, candidate in enumerate(asked, 1):
        with contextlib.suppress(RegnfError, MemoryError, RuntimeError), without_new_code():
            reading = candidate.make()
            if seconds_of(reading.description, reading.tensors, _SMALL_PICTURE) < deadline - time.process_time():
                drawn = field_picture(field_of(reading), reading.description.get("up_axis"), SMALL, look)
                drawn.save(out_dir / candidate_name(number))


def run(
    upload: Path,
    out_dir: Path,
    description: dict[str, Any] | None,
    limits: ImportLimits,
    picture: bool = False,
    beside: Companions | None = None,
    ask_by_picture: bool = False,
) -> dict[str, Any]:
    """``convert_file``'s report, or {"reason", "detail"} for every foreseen way to fail."""
    started = time.monotonic()
    try:
        return convert_file(upload, out_dir, description, limits, picture, beside)
    except AmbiguousError as error:
        if ask_by_picture:
            left_s = limits.longest_s - (time.monotonic() - started)
            draw_asked(error.asked, out_dir, min(_PICTURES_S, _PICTURES_SHARE * left_s))
        asked = [{"name": one.name, "description": one.say} for one in error.asked]
        return {"reason": error.reason, "detail": str(error), "candidates": asked}
    except FieldFormatError as error:
        return {"reason": error.reason, "detail": str(error), "hint": error.hint}
    except MemoryError:
        return {"reason": "IMPORT_OUT_OF_MEMORY", "detail": limits.no_memory()}
    except OSError as error:
        if error.errno == errno.ENOMEM:
            return {"reason": "IMPORT_OUT_OF_MEMORY", "detail": limits.no_memory()}
        if error.errno not in _OUTPUT_ERRORS:
            raise
        return {"reason": _OUTPUT_ERRORS[error.errno], "detail": os.strerror(error.errno)}


def main(arguments: list[str]) -> int:
    """The process: confine, convert, report."""
    request = json.load(sys.stdin)
    limits = ImportLimits(**request["limits"])
    out_dir = Path(arguments[0])
    os.environ["TMPDIR"] = arguments[0]  # where libraries that cannot do without put temporary files
    told = os.dup(sys.stdout.fileno())
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what libraries print is no part of the report
    # Opened while all is still allowed: a folder on the way may be open to this process's privileges only.
    opened = [os.open(path, os.O_RDONLY) for path in arguments[1:]]
    head = os.pread(opened[0], MARKED_BYTES, 0)
    threads = sniff_format(head[:HEAD_BYTES]) in _THREADED_FORMATS or any(mark in head for mark in _THREADED_MARKS)
    isolation = confine(limits, request["parent_pid"], opened, out_dir, threads)
    upload, *others = (Path(f"/proc/self/fd/{number}") for number in opened)
    named = {part: (request[part], others.pop(0)) for part in ("settings", "cameras") if request[part] is not None}
    beside, said = Companions(**named), request["description"]
    report = run(upload, out_dir, said, limits, request["picture"], beside, request["ask_by_picture"])
    report |= {"isolation": isolation, "peak_memory_bytes": _peak_memory()}
    with open(told, "w", encoding="utf-8") as answer:
        answer.write(json.dumps(report, allow_nan=False) + "\n")
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
