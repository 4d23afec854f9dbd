"""What a job repeats of its fields' imports: in its result all of it, in its record the words of the warnings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from regnf_core.field_notes import FieldNotes
from regnf_state.records import WARNINGS, FieldRecord

_MOST_WORDS = 16
_WORD_LENGTH = 64


def warned_of(scene: FieldRecord, objects: Sequence[FieldRecord]) -> dict[str, Any]:
    """An entry of a job's inputs: the words of the warnings of its scene, and of its object if it has one alone."""
    named = {"scene": scene} | ({"object": objects[0]} if len(objects) == 1 else {})
    words = {
        name: [word[:_WORD_LENGTH] for word in FieldNotes.of_report(one.report).words[:_MOST_WORDS]]
        for name, one in named.items()
    }
    found = {name: list(dict.fromkeys(said)) for name, said in words.items() if said}
    return {WARNINGS: found} if found else {}
