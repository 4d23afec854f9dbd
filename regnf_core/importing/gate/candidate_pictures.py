"""Pictures of the functions that a file may stand for, made in the gate's process while there is time for it."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from pathlib import Path

from regnf_core.errors import RegnfError
from regnf_core.importing.cost.mesh_work import Calls
from regnf_core.importing.gate.cost_estimate import seconds_of
from regnf_core.importing.gate.picture import candidate_name
from regnf_core.importing.gate.plausibility import without_new_code
from regnf_core.importing.gate.reading_field import field_of
from regnf_core.importing.gate.readings_beside import OpenCandidate
from regnf_core.viewing.field_picture import SMALL, field_picture

_WORK = Calls((40_000, 37_000), (12_000,))
"""About as many points as a small picture takes."""


class _OutOfTimeError(RegnfError):
    """Ends a drawing; nobody hears of it."""


def draw_candidates(candidates: Sequence[OpenCandidate], folder: Path, seconds: float) -> None:
    """Draw each to ``folder``/candidate-N.png, N from 1, as many as so many processor seconds allow."""
    deadline = time.process_time() + seconds
    for number, one in enumerate(candidates, 1):
        _draw(one, folder / candidate_name(number), deadline)


def _draw(candidate: OpenCandidate, path: Path, deadline: float) -> None:
    """A picture, if one can be made: the refusal does without. torch lacks memory with a RuntimeError."""

    def look(_: int) -> None:
        if time.process_time() > deadline:
            raise _OutOfTimeError("no time is left for the picture")

    with contextlib.suppress(RegnfError, MemoryError, RuntimeError), without_new_code():
        reading = candidate.make()
        if seconds_of(reading.description, reading.tensors, _WORK) < deadline - time.process_time():
            field_picture(field_of(reading), reading.description.get("up_axis"), SMALL, look).save(path)
