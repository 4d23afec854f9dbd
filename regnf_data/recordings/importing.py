"""A recording imported from an upload, in the throw-away process that fields are imported in.

Nothing of an upload is decoded elsewhere: what is kept is plain arrays (:mod:`regnf_data.recordings.stored`).
"""

from __future__ import annotations

import errno
import json
import math
import mmap
import os
import shutil
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from regnf_core.errors import FieldFormatError, RegnfError
from regnf_core.importing.gate.gate import checked_size, confined, request_of
from regnf_core.importing.gate.report import ImportLimits
from regnf_core.importing.recording_description import RecordingDescription

if TYPE_CHECKING:
    from regnf_core.importing.gate.child import ChildOutcome
    from regnf_data.recordings.recording import Recording

_MOST_FILES = 40_000
_MOST_NAMES = 2_000
"""Frames that a report names."""
_KEPT_BYTES = 1 << 30
"""Of the arrays that are kept of a recording; frames beyond are left out, those that add least first."""


def import_recording(
    upload: Path, out_dir: Path, description: dict[str, Any] | None = None, limits: ImportLimits | None = None
) -> dict[str, Any]:
    """Turn an upload into ``out_dir``/field.safetensors, a stored recording, and say what it holds.

    upload: an archive (zip, tar, packed or not) of a folder of any layout, a bag, or a stored recording · description:
    of a RecordingDescription. The report: kind, layout, frames (their names), left_out, size and color_size ([height,
    width]), bounds, depth_range (m), notes, warnings.
    Raises FieldFormatError and DatasetError with the reason, and OSError when the disk is full.
    """
    from regnf_core.importing.upload_description import described  # of pydantic, which the process does without

    limits = limits or ImportLimits.of_the_machine()
    request = request_of(described(RecordingDescription, description).non_default(), limits, {})
    return confined(__name__, [upload.resolve(strict=True)], out_dir, request, limits, _report, _MOST_FILES)


def _report(
    values: dict[str, Any], outcome: ChildOutcome, limits: ImportLimits, stored: Path, seconds: float
) -> dict[str, Any]:
    """What the child says, as far as it is plain, with what this side measured."""
    try:
        size = checked_size(stored, limits.file_bytes)
        ends = [[float(value) for value in corner] for corner in values["bounds"]]
        near, far = (float(value) for value in values["depth_range"])
        if not all(map(math.isfinite, (*ends[0], *ends[1], near, far))):
            raise ValueError("a number that is not finite")
        color = values["color_size"]
        return {
            "kind": "recording",
            "layout": str(values["layout"])[:100],
            "frames": [str(name)[:200] for name in values["frames"][:_MOST_NAMES]],
            "left_out": int(values["left_out"]),
            "size": [int(side) for side in values["size"]],
            "color_size": None if color is None else [int(side) for side in color],
            "bounds": ends,
            "depth_range": [near, far],
            "notes": [str(note)[:500] for note in values["notes"][:20]],
            "warnings": [str(warning)[:500] for warning in values["warnings"][:20]],
            "field_bytes": size,
            "seconds": round(seconds, 3),
            "cpu_seconds": round(outcome.cpu_seconds, 3),
            "isolation": {str(key): bool(value) for key, value in values["isolation"].items()},
        }
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError, IndexError, OSError) as error:
        raise FieldFormatError("the import ended without a result", reason="IMPORT_CRASHED") from error


# The process.

_MAGIC = {
    b"PK\x03\x04": "zip", b"\x1f\x8b": "gzip", b"BZh": "bzip2", b"\xfd7zXZ\x00": "xz",
    b"\x89MCAP0\r\n": ".mcap", b"SQLite format 3\x00": ".db3", b"#ROSBAG V2": ".bag",
}  # fmt: skip
_OUTPUT_ERRORS = {errno.EFBIG: "IMPORT_OUTPUT_TOO_LARGE", errno.ENOSPC: "STORAGE_FULL", errno.EDQUOT: "STORAGE_FULL"}


def main(arguments: list[str]) -> int:
    """Confine, read, write, report. Our own code is loaded before: where it lies may not be read afterwards. What is
    no argument comes with the request: the folder to work in and the upload."""
    from regnf_core.importing.containers import zip_members  # noqa: F401
    from regnf_core.importing.gate.sandbox import confine
    from regnf_core.importing.run import tar_run  # noqa: F401
    from regnf_data import agreement  # noqa: F401
    from regnf_data.recordings import bags, choosing, layouts, stored  # noqa: F401

    request = json.load(sys.stdin)
    arguments = arguments or request["arguments"]
    limits, folder = ImportLimits(**request["limits"]), Path(arguments[0])
    os.chdir(folder)
    opened = os.open(arguments[1], os.O_RDONLY)
    head = os.pread(opened, 512, 0)
    kind = next((kind for magic, kind in _MAGIC.items() if head.startswith(magic)), "")
    # Libraries choose by a file's ending: a link gives the upload one, made while links still may be.
    named = folder / f"upload{kind if kind.startswith('.') else '.safetensors'}"
    named.symlink_to(f"/proc/self/fd/{opened}")
    isolation = confine(limits, request["parent_pid"], [opened], folder, threads=True, folders=True)
    try:
        report = _converted(named, kind or ("tar" if head[257:262] == b"ustar" else ""), folder, request, limits)
    except RegnfError as error:
        report = {"reason": error.reason, "detail": str(error), "hint": error.hint}
    except MemoryError:
        report = {"reason": "IMPORT_OUT_OF_MEMORY", "detail": limits.no_memory()}
    except OSError as error:
        if error.errno not in _OUTPUT_ERRORS:
            raise
        report = {"reason": _OUTPUT_ERRORS[error.errno], "detail": os.strerror(error.errno)}
    sys.stdout.write(json.dumps(report | {"isolation": isolation}, allow_nan=False) + "\n")
    sys.stdout.flush()
    return 0


def _converted(upload: Path, kind: str, folder: Path, request: dict[str, Any], limits: ImportLimits) -> dict[str, Any]:
    from regnf_data.recordings.layouts import read_layout
    from regnf_data.recordings.recording import Given, check_recording
    from regnf_data.recordings.stored import recording_of_frames, write_recording

    source = upload
    if kind in ("zip", "tar", "gzip", "bzip2", "xz"):
        source = folder / "archive"
        unpack(upload, kind, source, limits.file_bytes // 2)
        source = inner_folder(source)
    recording = read_layout(source, Given.of(RecordingDescription(**request["description"])))
    if len(recording) == 1:  # somebody waits for it: it is decoded once
        recording = replace(recording, frames=recording_of_frames([recording.frames[0].read()]).frames)
    warning = check_recording(recording)
    kept, bounds = _kept(recording)
    stored = write_recording(recording, kept, folder / "field.safetensors")
    shutil.rmtree(folder / "archive", ignore_errors=True)
    return stored | {
        "layout": recording.layout,
        "left_out": len(recording) - len(stored["frames"]),
        "bounds": bounds.tolist(),
        "notes": list(recording.notes),
        "warnings": [] if warning is None else [warning],
    }


def unpack(upload: Path, kind: str, folder: Path, most: int) -> None:
    """Write an archive's files below ``folder``. Raises FieldFormatError with the ARCHIVE_* reasons."""
    with upload.open("rb") as file:
        # Closed with the last view of it: an error may hold one.
        data = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    folder.mkdir()
    for name, content in _members(data, kind, most):
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(content)


def _members(data: memoryview, kind: str, most: int) -> Iterator[tuple[str, bytes]]:
    from regnf_core.importing.containers.zip_members import DEFLATED, STORED, read_members, require_modest
    from regnf_core.importing.run.tar_run import TarRun

    if kind == "zip":
        members = read_members(data, (STORED, DEFLATED), True, _MOST_FILES)
        require_modest(sum(one.size for one in members), len(data), most)
        for one in members:
            if not one.name.endswith("/"):
                content = one.content(data)
                yield one.name, bytes(content)
                del content
    else:
        archive = TarRun(data, None if kind == "tar" else kind, most, _MOST_FILES)
        require_modest(sum(archive.sizes.values()), len(data), most)
        yield from archive.each()


def inner_folder(folder: Path) -> Path:
    """The folder itself, or the only one in it, where an archive holds nothing else."""
    inside = [one for one in folder.iterdir() if one.name not in ("__MACOSX", ".DS_Store")]
    return inner_folder(inside[0]) if len(inside) == 1 and inside[0].is_dir() else folder


def _kept(recording: Recording) -> tuple[list[int], Any]:
    """The frames that are kept, and the bounds of what they show."""
    from regnf_data.recordings.choosing import choose_frames

    first = recording.frames[0].read()
    one = first.depth.size * 2 + (0 if first.color is None else first.color.size)
    most = max(1, _KEPT_BYTES // one)
    chosen = choose_frames(recording, most)
    return list(range(len(recording))) if len(recording) <= most else list(chosen.indices), chosen.bounds


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
