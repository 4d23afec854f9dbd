"""The files that a registration leaves: those of its folder, and its recording."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from regnf_cli.console import err
from regnf_core.files import filled_folder, require_writable

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

    def check(self) -> None:
        """Raises PermissionError before the work, which would be lost if nothing may be written there."""
        for folder in (self.output, self.recording and self.recording.parent):
            if folder is not None:
                require_writable(folder)

    def write(self, result: RegistrationResult, box: OrientedBox, **said: Any) -> None:
        """Write what is wanted, each file whole or not at all; ``said`` goes on to ``write_artifacts``."""
        from regnf_core.viewing.recording import write_recording

        write_into(self.output, result, **said)
        if self.recording is not None:
            write_recording(result, self.recording, box, said["object_name"])


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
    with filled_folder(output) as folder:
        write_artifacts(result, folder, **said)
