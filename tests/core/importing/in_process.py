"""The gate's conversion without a process of its own, which takes longer than most conversions. gate/ tests that."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from regnf_core.importing.gate.convert import convert_file
from regnf_core.importing.gate.reading import Companions
from regnf_core.importing.gate.report import ImportLimits


def convert(
    upload: Path, folder: Path, description: dict[str, Any] | None = None, settings: Path | None = None
) -> dict[str, Any]:
    """The report of ``upload``, whose field is written below ``folder``."""
    folder.mkdir()
    named = None if settings is None else (settings.name, settings)
    return convert_file(upload, folder, description, ImportLimits(), beside=Companions(settings=named))
