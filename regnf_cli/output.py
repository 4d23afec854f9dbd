"""The files that a registration leaves: those of its folder, and its recording."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from regnf_cli.console import err

if TYPE_CHECKING:
    from regnf_core.geometry.box import OrientedBox
    from regnf_core.result import RegistrationResult


@dataclass(frozen=True)
class Files:
    """What a registration here is to write. output: a folder · recording: a file."""

    output: Path | None = None
    recording: Path | None = None

    @property
    def wanted(self) -> bool:
        """Whether anything is."""
        return self.output is not None or self.recording is not None

    def prepare(self) -> None:
        """Make the folders before the work."""
        prepare(self.output)
        prepare(self.recording and self.recording.parent)

    def write(self, result: RegistrationResult, box: OrientedBox, **said: Any) -> None:
        """Write what is wanted, each file whole or not at all; ``said`` goes on to ``write_artifacts``."""
        from regnf_core.viewing.recording import write_recording

        write_into(self.output, result, **said)
        if self.recording is not None:
            write_recording(result, self.recording, box, said["object_name"])


def prepare(output: Path | None) -> None:
    """Make the folder before the work, which would be lost if it cannot be made."""
    if output is not None:
        output.mkdir(parents=True, exist_ok=True)


def tell_files(output: Path | None, recording: Path | None = None) -> None:
    """Say where the files are, on stderr: the document on stdout may be JSON."""
    if output is not None:
        err.print(f"wrote {output}: result.json, preview.png, point clouds", markup=False, soft_wrap=True)
    if recording is not None:
        err.print(f"wrote {recording}", markup=False, soft_wrap=True)


def write_into(output: Path | None, result: RegistrationResult, **said: Any) -> None:
    """Write every artifact, each whole or not at all; ``said`` goes on to ``write_artifacts``."""
    from regnf_core.viewing import write_artifacts

    if output is None:
        return
    with tempfile.TemporaryDirectory(dir=output) as folder:
        for name in write_artifacts(result, Path(folder), **said):
            (Path(folder) / name).replace(output / name)
