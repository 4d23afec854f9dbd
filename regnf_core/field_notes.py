"""What an import found out about a field and what every result that uses the field repeats. Torch-free."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

WARNINGS = "warnings"
"""The entry of a regnf field file's ``source`` that has the warnings of its import."""
ASSUMED = "assumed"
"""The entry that has what the import took for granted."""
_WARNING, _ASSUMPTION = re.compile(r"[A-Z][A-Z0-9_]{2,63}: "), re.compile(r"[a-z]{3,16}: ")
_MOST, _LONGEST = 16, 400


@dataclass(frozen=True)
class FieldNotes:
    """family: the format that was recognized · settings: those of the trainer that counted, see ImportReport ·
    warnings: of the import, each with its word first · assumed: what the file did not say, each with its subject
    first."""

    family: str | None = None
    settings: Mapping[str, Any] | None = None
    warnings: tuple[str, ...] = ()
    assumed: tuple[str, ...] = ()

    @classmethod
    def of_report(cls, report: Mapping[str, Any]) -> FieldNotes:
        """From an import's report, as a record or a file holds it; what it does not say is left out."""
        family, settings, *listed = (report.get(name) for name in ("family", "settings", WARNINGS, ASSUMED))
        texts = (tuple(map(str, each)) if isinstance(each, list | tuple) else () for each in listed)
        return cls(str(family) if family else None, settings if isinstance(settings, Mapping) else None, *texts)

    @classmethod
    def of_source(cls, source: Mapping[str, Any]) -> FieldNotes:
        """From what a regnf field file says of its origin: the warnings of its import."""
        return cls(warnings=kept_warnings(source.get(WARNINGS)), assumed=kept_assumptions(source.get(ASSUMED)))

    def to_dict(self) -> dict[str, Any]:
        """Plain (JSON) values."""
        settings = None if self.settings is None else dict(self.settings)
        told = {WARNINGS: list(self.warnings), ASSUMED: list(self.assumed)}
        return {"family": self.family, "settings": settings, **told}

    @property
    def words(self) -> list[str]:
        """The stable words of the warnings."""
        return [warning.partition(":")[0] for warning in self.warnings]


def kept_warnings(values: object) -> tuple[str, ...]:
    """Of what a file may hold as an import's warnings, those that are: a word, a colon and a short printable text."""
    return _kept(values, _WARNING)


def kept_assumptions(values: object) -> tuple[str, ...]:
    """The same of what it may hold as assumptions: a subject, a colon and a short printable text."""
    return _kept(values, _ASSUMPTION)


def _kept(values: object, begin: re.Pattern[str]) -> tuple[str, ...]:
    listed = values if isinstance(values, list) else []
    sound = [text[:_LONGEST] for text in listed if isinstance(text, str) and begin.match(text) and text.isprintable()]
    return tuple(sound[:_MOST])


NO_NOTES = FieldNotes()
"""Of a field of which nothing is known."""


# What people look at of a stored field. Torch-free.

PICTURE_NAME = "preview.png"
MESH_NAMES = ("mesh.glb", "mesh-coarse.glb")
"""Fine and coarse."""


@dataclass(frozen=True)
class FieldViews:
    """The bytes of two GLB files and a PNG; None for what there is not. There is no coarse mesh of a small surface."""

    fine: bytes | None = None
    coarse: bytes | None = None
    picture: bytes | None = None

    def files(self) -> dict[str, bytes]:
        found = zip((*MESH_NAMES, PICTURE_NAME), (self.fine, self.coarse, self.picture), strict=True)
        return {name: data for name, data in found if data is not None}
