"""One of several functions that a file may stand for, where nothing in it tells which: what a person is asked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

MOST_CANDIDATES = 6
"""So many are shown at most, the likeliest first."""


@dataclass(frozen=True)
class Candidate:
    """name: what distinguishes it, a few words · description: the entries of a description that choose it, to be added
    to what was said · picture: a PNG, two views of its surface and a section, where one could be made."""

    name: str
    description: Mapping[str, Any]
    picture: bytes | None = None

    def added_to(self, said: Mapping[str, Any]) -> dict[str, Any]:
        """The whole description that chooses it, where ``said`` was said before."""
        return _merged(said, self.description)


@dataclass(frozen=True)
class Said:
    """What a user said of a field. use: what it was named as on a command line, scene or object, where that is known ·
    description: its entries, see UploadDescription."""

    use: str | None
    description: Mapping[str, Any]


def _merged(said: Mapping[str, Any], more: Mapping[str, Any]) -> dict[str, Any]:
    whole = dict(said)
    for name, value in more.items():
        held = whole.get(name)
        whole[name] = _merged(held, value) if isinstance(held, Mapping) and isinstance(value, Mapping) else value
    return whole
