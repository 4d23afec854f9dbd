"""What an import found out about a field and what every result that uses the field repeats. Torch-free."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class FieldNotes:
    """family: the format that was recognized · settings: those of the trainer that counted, see ImportReport ·
    warnings: of the import, each with its word first."""

    family: str | None = None
    settings: Mapping[str, Any] | None = None
    warnings: tuple[str, ...] = ()

    @classmethod
    def of_report(cls, report: Mapping[str, Any]) -> FieldNotes:
        """From an import's report, as a record or a file holds it; what it does not say is left out."""
        family, settings, warnings = (report.get(name) for name in ("family", "settings", "warnings"))
        texts = tuple(map(str, warnings)) if isinstance(warnings, list | tuple) else ()
        return cls(str(family) if family else None, settings if isinstance(settings, Mapping) else None, texts)

    def to_dict(self) -> dict[str, Any]:
        """Plain (JSON) values."""
        settings = None if self.settings is None else dict(self.settings)
        return {"family": self.family, "settings": settings, "warnings": list(self.warnings)}

    @property
    def words(self) -> list[str]:
        """The stable words of the warnings."""
        return [warning.partition(":")[0] for warning in self.warnings]


NO_NOTES = FieldNotes()
"""Of a safe field that was given as it is: its import was another time."""
