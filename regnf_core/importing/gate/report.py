"""What an import may use, and what it reports. Torch- and numpy-free."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

MIB = 1024 * 1024


@dataclass(frozen=True)
class ImportLimits:
    """Bounds of one import. Beyond any of them it ends with a reason, and nothing of it stays."""

    wall_s: float = 120.0
    """Seconds from start to end; then IMPORT_TIMEOUT."""
    cpu_s: int = 240
    """Processor seconds; then IMPORT_TIMEOUT."""
    work_s: float = 60.0
    """Seconds of one core that the field's evaluation is estimated to take; then IMPORT_TOO_COSTLY, at once."""
    memory_bytes: int = 8192 * MIB
    """Address space, the mapped upload (and about 1 GiB of libraries) included; then IMPORT_OUT_OF_MEMORY."""
    tensor_bytes: int = 4096 * MIB
    """All tensors of the field together, as float32; then TENSOR_TOO_LARGE."""
    file_bytes: int = 4096 * MIB
    """Largest file the import may write; then IMPORT_OUTPUT_TOO_LARGE."""


@dataclass(frozen=True)
class ImportReport:
    """An import that succeeded. Lengths are in the field's own units, its own frame."""

    family: str
    """The format of the file: which trainer or program wrote it."""
    kind: str
    """The kind of the stored field: which function it is; see docs/safe-format.md."""
    why: tuple[str, ...]
    """The evidence for the family, one short sentence each."""
    bounds: tuple[tuple[float, float, float], tuple[float, float, float]]
    """Lowest and highest corner of the region where the field has meaning."""
    surface_bounds: tuple[tuple[float, float, float], tuple[float, float, float]]
    """The same of the surface: of some thousand points on it, so a thin end may reach a little further."""
    parameters: int
    plausibility: dict[str, float]
    """What was measured of the evaluated field; see ``plausibility``."""
    warnings: tuple[str, ...]
    """Each begins with a stable UPPER_SNAKE word and a colon."""
    label: str | None
    settings: dict[str, Any] | None
    """The trainer's settings that counted: ``trainer``, ``files`` (their names) and ``used`` (entries of a description,
    such as hash.levels, and their values). None where there were none."""
    field_bytes: int
    seconds: float
    cpu_seconds: float
    peak_memory_bytes: int
    isolation: dict[str, bool]
    """Which of the child's confinements the kernel granted."""

    def to_dict(self) -> dict[str, Any]:
        """Plain (JSON) values."""
        return dataclasses.asdict(self)
