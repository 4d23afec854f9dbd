"""The refusal of a file that may be one of several functions, with the functions themselves."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from regnf_core.errors import MOST_CANDIDATES, FieldFormatError
from regnf_core.importing.families.converted import ConvertedField, Reading


@dataclass(frozen=True)
class OpenCandidate:
    """name: what distinguishes it · say: the entries of a description that choose it · make: gives its function."""

    name: str
    say: dict[str, Any]
    make: Callable[[], Reading] = field(repr=False)


class AmbiguousError(FieldFormatError):
    """The evidence leaves several functions; ``asked`` holds those that are shown, the likeliest first."""

    reason = "LAYOUT_AMBIGUOUS"

    def __init__(self, message: str, asked: Sequence[OpenCandidate]) -> None:
        super().__init__(message)
        lines: dict[str, OpenCandidate] = {}
        for one in asked:
            if one.say:
                lines.setdefault(json.dumps(one.say, sort_keys=True), one)
        self.asked = tuple(lines.values())[:MOST_CANDIDATES]


def require_told(converted: ConvertedField) -> None:
    """Raise AmbiguousError where the file leaves functions between which no behavior decides."""
    if not converted.untold:
        return
    reading = Reading(converted.family, converted.description, converted.tensors)
    asked = [OpenCandidate(one.name, one.say, partial(one.of, reading)) for one in converted.untold]
    lines = " or ".join(json.dumps(one.say) for one in asked)
    message = f"neither the tensors nor how they behave tell which function this is; add to the description {lines}"
    raise AmbiguousError(message, asked)
