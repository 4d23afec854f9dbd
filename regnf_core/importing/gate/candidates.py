"""What the gate's process says a file may stand for, checked before anybody is asked: entries, names, pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from regnf_core.errors import FieldFormatError
from regnf_core.field_candidates import MOST_CANDIDATES, Candidate
from regnf_core.importing.gate.picture import CANDIDATE_BYTES, candidate_name, is_sound_picture

_MAX_NAME = 300


def read_candidates(values: Any, folder: Path) -> tuple[Candidate, ...]:
    """Those of ``values`` that are sound, their pictures from ``folder``; what else it says is left out."""
    listed = values if isinstance(values, list) else []
    found = (_candidate(value, folder, number) for number, value in enumerate(listed[:MOST_CANDIDATES], 1))
    return tuple(one for one in found if one is not None)


def _candidate(value: Any, folder: Path, number: int) -> Candidate | None:
    from regnf_core.importing.upload_description import UploadDescription  # loads pydantic

    match value:
        case {"name": str() as name, "description": dict() as said}:
            pass
        case _:
            return None
    try:
        entries = UploadDescription.from_dict(said).non_default()
    except FieldFormatError:
        return None
    plain = "".join(c for c in name if c.isprintable())[:_MAX_NAME]
    return Candidate(plain, entries, _picture(folder / candidate_name(number))) if entries else None


def _picture(path: Path) -> bytes | None:
    return path.read_bytes() if is_sound_picture(path, CANDIDATE_BYTES) else None
