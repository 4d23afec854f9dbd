"""Readings whose levels are a little coarser or finer than another's, to see where the evidence peaks."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from regnf_core.errors import MOST_CANDIDATES, FieldFormatError
from regnf_core.importing.families.converted import ConvertedField, Reading
from regnf_core.importing.families.grid_search import finest_of, grid_name
from regnf_core.schema.hash_grid_config import MAX_GROWTH, HashGridConfig

_FINEST = (-0.24, -0.12, -0.06, math.log(2000 / 2048), 0.06, 0.12, 0.24)
"""How far the finest resolutions lie from the reading's own, as natural logarithms. Next to a power of two is the round
number below it."""
_COARSEST = (-0.24, -0.12, 0.12, 0.24)
"""The same of the coarsest resolutions, the finest one being kept."""
_REACH = 0.12
"""How far the finest resolutions lie at most that are tried because somebody would write them."""


def readings_beside(reading: Reading, tier: int) -> Iterator[Reading]:
    """The same reading with other growths or other coarsest resolutions, as far as the table has the size for them.

    tier: of the most usual numbers there are.
    """
    grid = HashGridConfig(**reading.description["hash"])
    if grid.levels == 1 or grid.resolutions is not None or grid.strides is not None:
        return
    steps = grid.levels - 1
    others = [replace(grid, per_level_scale=grid.per_level_scale * math.exp(more / steps)) for more in _FINEST]
    top = grid.base_resolution * grid.per_level_scale**steps
    for more in _COARSEST:
        base = max(1, round(grid.base_resolution * math.exp(more)))
        others.append(replace(grid, base_resolution=base, per_level_scale=(top / base) ** (1.0 / steps)))
    for other in others:
        if other.base_resolution == grid.base_resolution and other.per_level_scale == grid.per_level_scale:
            continue
        made = _of_size(other, grid.entries) if 1.0 <= other.per_level_scale <= MAX_GROWTH else None
        if made is not None:
            said = {"base_resolution": made.base_resolution, "top_resolution": round(math.exp(finest_of(made)))}
            yield replace(_said(reading, made, said), tier=tier + 2, is_written=False)


def readings_written_near(reading: Reading, tier: int) -> Iterator[Reading]:
    """The same reading with the finest resolutions of two digits, or of five binary ones, nearest to its own first.

    tier: of the most usual numbers there are.
    """
    grid = HashGridConfig(**reading.description["hash"])
    if grid.levels == 1 or grid.resolutions is not None or grid.strides is not None:
        return
    top = grid.base_resolution * grid.per_level_scale ** (grid.levels - 1)
    lowest, highest = math.ceil(top * math.exp(-_REACH)), math.floor(top * math.exp(_REACH))
    units = 10 ** max(0, len(str(highest)) - 2), 1 << max(0, highest.bit_length() - 5)
    written = [number for number in range(lowest, highest + 1) if any(number % unit == 0 for unit in units)]
    for number in sorted(written, key=lambda number: abs(math.log(number / top))):
        power = number & (number - 1) == 0
        growth = (number / grid.base_resolution) ** (1.0 / (grid.levels - 1))
        made = _of_size(replace(grid, per_level_scale=growth), grid.entries) if growth >= 1.0 else None
        if made is not None:
            said = {"base_resolution": grid.base_resolution, "top_resolution": number}
            yield replace(_said(reading, made, said), tier=tier + (not power), is_written=True)


def _of_size(grid: HashGridConfig, entries: int) -> HashGridConfig | None:
    try:
        return grid.with_entry_count(entries)
    except FieldFormatError:
        return None


def _said(reading: Reading, grid: HashGridConfig, said: dict[str, int]) -> Reading:
    """``reading`` with this grid, and with what to say of it in a description."""
    parts = {name: value for name, value in reading.say.get("hash", {}).items() if name != "per_level_scale"}
    say = {**reading.say, "hash": {**parts, **said}}
    described = {**reading.description, "hash": grid.described()}
    return replace(reading, name=grid_name(grid), say=say, description=described, scale=finest_of(grid))


# The refusal of a file that may be one of several functions, with the functions themselves.


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
