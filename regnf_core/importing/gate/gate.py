"""The gate's outer side: runs one conversion in a child process and trusts only what it checks itself."""

from __future__ import annotations

import errno
import json
import logging
import math
import mmap
import os
import re
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from regnf_core.errors import MOST_CANDIDATES, Candidate, FieldFormatError
from regnf_core.importing.containers.safetensors_header import read_header
from regnf_core.importing.gate.child import MAX_ENTRIES, ChildOutcome, run_child, start_child
from regnf_core.importing.gate.picture import CANDIDATE_BYTES, PICTURE_NAME, candidate_name, is_sound_picture
from regnf_core.importing.gate.report import ImportLimits, ImportReport

T = TypeVar("T")

# What the gate's process says a file may stand for, checked before anybody is asked: entries, names, pictures.

_MAX_CANDIDATE_NAME = 300


def read_candidates(values: Any, folder: Path) -> tuple[Candidate, ...]:
    """Those of ``values`` that are sound, their pictures from ``folder``; what else it says is left out."""
    listed = values if isinstance(values, list) else []
    found = (_candidate(value, folder, number) for number, value in enumerate(listed[:MOST_CANDIDATES], 1))
    return tuple(one for one in found if one is not None)


def _candidate(value: Any, folder: Path, number: int) -> Candidate | None:
    from regnf_core.importing.upload_description import UploadDescription

    match value:
        case {"name": str() as name, "description": dict() as said}:
            pass
        case _:
            return None
    try:
        entries = UploadDescription.from_dict(said).non_default()
    except FieldFormatError:
        return None
    if not entries:
        return None
    picture = folder / candidate_name(number)
    plain = "".join(c for c in name if c.isprintable())[:_MAX_CANDIDATE_NAME]
    return Candidate(plain, entries, picture.read_bytes() if is_sound_picture(picture, CANDIDATE_BYTES) else None)


__all__ = ["FIELD_NAME", "ImportLimits", "ImportReport", "import_field"]

FIELD_NAME = "field.safetensors"
"""The name of the regnf field file in the output folder."""

_ROOT = Path(__file__).resolve().parents[3]
_ENTRY = """
import sys
if sys.argv[1] not in sys.path:
    sys.path.insert(0, sys.argv[1])
from importlib import import_module
sys.exit(import_module(sys.argv[2]).main(sys.argv[3:]))
"""
_FIELDS = "regnf_core.importing.gate.convert"
_REASON = re.compile(r"[A-Z][A-Z0-9_]{2,63}")
_MAX_DETAIL = 1000
_OUT_OF_MEMORY_SIGNS = (
    *(b"MemoryError", b"bad_alloc", b"DefaultCPUAllocator", b"Cannot allocate memory", b"failed to map segment"),
)
_MAX_DESCRIPTION = 16_384
_MAX_NAME = 120
_PICTURE_BYTES = 16 << 20
"""What the import may write besides the field."""
_log = logging.getLogger(__name__)


def import_field(
    upload: Path,
    out_dir: Path,
    description: dict[str, Any] | None = None,
    limits: ImportLimits | None = None,
    picture: bool = False,
    settings: Path | None = None,
    cameras: Path | None = None,
    ask_by_picture: bool = False,
) -> ImportReport:
    """Turn an uploaded file into ``out_dir``/field.safetensors, in a throw-away process that can reach nothing.

    description: what the uploader says that the file does not; see UploadDescription. On failure nothing is left in
    ``out_dir``, which is made if need be. Blocks for at most ``limits.wall_s`` and a little, where that is set.
    picture: leave a picture of the field in ``out_dir``/preview.png too, if it can be made in good time; it implies
    ask_by_picture: leave in the error one of each function that the file may stand for. settings: the trainer's own,
    one file or an archive of several. cameras: where those stood whose images the field was made from, likewise.
    The upload may be an archive of a whole run; then it brings its settings along.

    limits: None takes those of the machine.

    Raises FieldFormatError with the reason (docs/import-gate.md lists them), FileNotFoundError without an upload, and
    OSError when the disk is full.
    """
    limits = limits or ImportLimits.of_the_machine()
    shown = {"picture": picture, "ask_by_picture": picture or ask_by_picture}
    request = request_of(description, limits, shown, settings, cameras)
    files = [path.resolve(strict=True) for path in (upload, settings, cameras) if path is not None]
    return confined(_FIELDS, files, out_dir, request, limits, _report)


Read = Callable[[dict[str, Any], ChildOutcome, ImportLimits, Path, float], T]
"""What the child has said, how it ended, its limits, the file that it wrote, seconds -> what that is worth here."""


def confined(
    module: str,
    files: list[Path],
    out_dir: Path,
    request: bytes,
    limits: ImportLimits,
    read: Read[T],
    entries: int = MAX_ENTRIES,
) -> T:
    """Have ``module``'s ``main`` turn ``files`` into ``out_dir``/field.safetensors, in a throw-away process.

    entries: files and folders that it may have at once. Raises what ``import_field`` does.
    """
    out_dir.mkdir(parents=True, exist_ok=True)
    started = time.monotonic()
    once = partial(_import_once, module, files, out_dir, request, limits, started, read, entries)
    try:
        return once()
    except _KilledError:
        _log.warning("the import's process was killed from outside; it is started again")
    try:
        return once()
    except _KilledError as error:
        raise FieldFormatError(
            "the import needs more memory than the machine has", reason="IMPORT_OUT_OF_MEMORY"
        ) from error


_early: dict[str, subprocess.Popen[bytes]] = {}
"""Processes that have loaded what ``main`` of a module needs, and wait for a request with ``arguments``."""


def start_early(module: str) -> None:
    """Start the process of the next ``confined`` call for ``module`` now: it then has loaded what it needs."""
    _early[module] = start_child(_command(module), _environment())


def _command(module: str, *arguments: str) -> list[str]:
    return [sys.executable, "-I", "-B", "-c", _ENTRY, str(_ROOT), module, *arguments]


class _KilledError(Exception):
    """Somebody else than this side killed the child: the kernel for want of memory, or a person."""


def _import_once(
    module: str,
    files: list[Path],
    out_dir: Path,
    request: bytes,
    limits: ImportLimits,
    started: float,
    read: Read[T],
    entries: int,
) -> T:
    """One child, within what is left of the time since ``started``. Raises _KilledError, and as ``import_field``."""
    work = Path(tempfile.mkdtemp(prefix=".import-", dir=out_dir))
    left_s = max(0.0, limits.longest_s - (time.monotonic() - started))
    try:
        given = [str(work.resolve()), *map(str, files)]
        process = _early.pop(module, None)
        if process is not None:
            request = json.dumps(json.loads(request) | {"arguments": given}).encode()
        start, room = process or _command(module, *given), limits.file_bytes + _PICTURE_BYTES
        outcome = run_child(start, request, work, _environment(), left_s, room, entries)
        values = _values_of(outcome, work, limits, time.monotonic() - started)
        report = read(values, outcome, limits, work / FIELD_NAME, time.monotonic() - started)
        os.replace(work / FIELD_NAME, out_dir / FIELD_NAME)
        if json.loads(request).get("picture") and is_sound_picture(work / PICTURE_NAME):
            os.replace(work / PICTURE_NAME, out_dir / PICTURE_NAME)
        return report
    finally:
        shutil.rmtree(work, ignore_errors=True)


def request_of(
    description: dict[str, Any] | None,
    limits: ImportLimits,
    shown: dict[str, bool],
    settings: Path | None = None,
    cameras: Path | None = None,
) -> bytes:
    """What a process is asked. Raises FieldFormatError (INVALID_DESCRIPTION)."""
    try:
        request = {
            "description": description,
            "limits": asdict(limits),
            "parent_pid": os.getpid(),
            **shown,
            "settings": None if settings is None else settings.name[-_MAX_NAME:],
            "cameras": None if cameras is None else cameras.name[-_MAX_NAME:],
        }
        text = json.dumps(request, allow_nan=False).encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise FieldFormatError("the description is not JSON", reason="INVALID_DESCRIPTION") from error
    if len(text) > _MAX_DESCRIPTION:
        raise FieldFormatError("the description is too long", reason="INVALID_DESCRIPTION")
    return text


def _environment() -> dict[str, str]:
    """All the child gets to see of the environment: no secret lives in these names. It may not have threads."""
    counts = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "IGL_NUM_THREADS", "PXR_WORK_THREAD_LIMIT")
    return {"PATH": os.defpath, "LANG": "C.UTF-8", **dict.fromkeys(counts, "1")}


def _values_of(outcome: ChildOutcome, work: Path, limits: ImportLimits, seconds: float) -> dict[str, Any]:
    """The report's values, or the error that the child's end stands for. work: where it may have left pictures.

    seconds: how long it ran.
    """
    if outcome.stopped == "late" or outcome.signal == signal.SIGXCPU:
        used = f"stopped after {seconds:.1f} s and {outcome.cpu_seconds:.1f} s of processor time"
        raise FieldFormatError(f"the import took longer than {limits.longest_s:g} s: {used}", reason="IMPORT_TIMEOUT")
    if outcome.stopped == "output":
        told = f"the import writes more than the {limits.file_bytes >> 20} MiB that are allowed"
        raise FieldFormatError(told, reason="IMPORT_OUTPUT_TOO_LARGE")
    if outcome.stopped is None and outcome.signal == signal.SIGKILL:
        raise _KilledError
    values = _parse(outcome.stdout) if outcome.exit_status == 0 else None
    if values is None:
        if any(sign in outcome.stderr for sign in _OUT_OF_MEMORY_SIGNS):
            raise FieldFormatError(limits.no_memory(), reason="IMPORT_OUT_OF_MEMORY")
        ending = f"status {outcome.exit_status}, signal {outcome.signal}, stopped {outcome.stopped}"
        _log.error("import process failed (%s): %s", ending, outcome.stderr[-4000:].decode("utf-8", "replace"))
        raise FieldFormatError("the import ended without a result", reason="IMPORT_CRASHED")
    reason = values.get("reason")
    if reason is None:
        return values
    if not isinstance(reason, str) or not _REASON.fullmatch(reason):
        raise FieldFormatError("the import ended without a result", reason="IMPORT_CRASHED")
    detail, hint = (_printable(values.get(name)) for name in ("detail", "hint"))
    if reason == "STORAGE_FULL":
        raise OSError(errno.ENOSPC, detail)
    raise FieldFormatError(
        detail, reason=reason, hint=hint or None, candidates=read_candidates(values.get("candidates"), work)
    )


def _printable(text: Any) -> str:
    return "".join(c for c in str(text or "")[:_MAX_DETAIL] if c.isprintable())


def _parse(stdout: bytes) -> dict[str, Any] | None:
    try:
        values = json.loads(stdout)
    except (ValueError, RecursionError):
        return None
    return values if isinstance(values, dict) else None


def _report(
    values: dict[str, Any], outcome: ChildOutcome, limits: ImportLimits, field: Path, seconds: float
) -> ImportReport:
    """The report from the child's own words and this side's measurements, after a look at the file it left."""
    try:
        size = checked_size(field, limits.file_bytes)
        isolation = {str(key): bool(value) for key, value in values["isolation"].items()}
        lower, upper = ((_finite(x), _finite(y), _finite(z)) for x, y, z in values["bounds"])
        lowest, highest = ((_finite(x), _finite(y), _finite(z)) for x, y, z in values["surface_bounds"])
        return ImportReport(
            family=str(values["family"]),
            kind=str(values["kind"]),
            why=tuple(map(str, values["why"])),
            bounds=(lower, upper),
            surface_bounds=(lowest, highest),
            parameters=int(values["parameters"]),
            plausibility={str(key): _finite(value) for key, value in values["plausibility"].items()},
            warnings=(*map(str, values["warnings"]), *_isolation_warnings(isolation)),
            assumed=tuple(map(str, values["assumed"])),
            label=None if values["label"] is None else str(values["label"]),
            settings=_settings(values.get("settings")),
            field_bytes=size,
            seconds=round(seconds, 3),
            cpu_seconds=round(outcome.cpu_seconds, 3),
            peak_memory_bytes=int(values["peak_memory_bytes"]),
            isolation=isolation,
        )
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError, OSError, FieldFormatError) as error:
        _log.error("import process left no usable result: %r", error)
        raise FieldFormatError("the import ended without a result", reason="IMPORT_CRASHED") from error


def _settings(values: Any) -> dict[str, Any] | None:
    """Which settings were used: plain, flat values, as the report promises them."""
    if values is None:
        return None
    used = {str(name): value for name, value in values["used"].items()}
    if not all(
        value is None or isinstance(value, (bool, int, str)) or _finite(value) is not None for value in used.values()
    ):
        raise ValueError("a setting that is not a plain value")
    return {"trainer": str(values["trainer"]), "files": [str(name) for name in values["files"]], "used": used}


def _finite(value: Any) -> float:
    """The number, if JSON can hold it: Python's reader takes NaN and 1e999 too."""
    number = float(value)
    if not math.isfinite(number):
        raise ValueError("a number that is not finite")
    return number


def _isolation_warnings(isolation: dict[str, bool]) -> list[str]:
    if isolation.get("network_namespace") or isolation.get("system_call_filter"):
        return []
    return ["NOT_ISOLATED: the kernel gave the import neither a network namespace nor a system call filter"]


def checked_size(field: Path, most: int) -> int:
    """The file's size, if it is a plain file of its own (no link) with a sound safetensors header."""
    found = field.lstat()
    if not stat.S_ISREG(found.st_mode) or found.st_nlink != 1 or not 0 < found.st_size <= most:
        raise ValueError("the import wrote something other than a plain file")
    with open(field, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as mapped:
        data = memoryview(mapped)
        try:
            read_header(data)
        finally:
            data.release()
    return found.st_size
