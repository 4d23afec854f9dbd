"""What an import found out about a field and what every result that uses the field repeats. Torch-free."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class FieldNotes:
    """family: the format that was recognized · settings: the trainer's files that were used · warnings: of the import,
    each with its word first."""

    family: str | None = None
    settings: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    @classmethod
    def of_report(cls, report: Mapping[str, Any]) -> FieldNotes:
        """From an import's report, as a record or a file holds it; what it does not say is left out."""
        family, settings, warnings = (report.get(name) for name in ("family", "settings", "warnings"))
        return cls(str(family) if family else None, _texts(settings), _texts(warnings))

    def to_dict(self) -> dict[str, Any]:
        """Plain (JSON) values."""
        return {"family": self.family, "settings": list(self.settings), "warnings": list(self.warnings)}

    @property
    def words(self) -> list[str]:
        """The stable words of the warnings."""
        return [warning.partition(":")[0] for warning in self.warnings]


NO_NOTES = FieldNotes()
"""Of a safe field that was given as it is: its import was another time."""


def _texts(value: object) -> tuple[str, ...]:
    return tuple(map(str, value)) if isinstance(value, list | tuple) else ()
