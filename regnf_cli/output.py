"""The folder that a registration's files are written into."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from regnf_core.result import RegistrationResult


def prepare(output: Path | None) -> None:
    """Make the folder before the work, which would be lost if it cannot be made."""
    if output is not None:
        output.mkdir(parents=True, exist_ok=True)


def write_into(output: Path | None, result: RegistrationResult, **said: Any) -> None:
    """Write every artifact, each whole or not at all; ``said`` goes on to ``write_artifacts``."""
    from regnf_core.viewing import write_artifacts

    if output is None:
        return
    with tempfile.TemporaryDirectory(dir=output) as folder:
        for name in write_artifacts(result, Path(folder), **said):
            (Path(folder) / name).replace(output / name)
