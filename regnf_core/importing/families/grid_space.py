"""The hash grids that a table's size leaves open, and which of them somebody would have put into a configuration."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from regnf_core.errors import FieldFormatError
from regnf_core.importing.families.grid_solver import MAX_BASE, GridInterval
from regnf_core.schema.hash_grid_config import MAX_GROWTH, HashGridConfig, Interpolation

_EDGE = 1e-5
"""Relative reach beyond an interval's ends: another machine may have rounded there."""
_USUAL_BASES = (16, 32, 8, 64, 4, 128)
_MAX_TOP = 1 << 14
_MOST_ROUND = 40
"""Finest resolutions of an interval that are listed beside the powers of two, at most."""

_COPIED = tuple(2.0 ** (k / 15) for k in range(4, 11))
"""Growths from one power of two to another over the usual 16 levels, which are written with other numbers of levels,
too."""


@dataclass(frozen=True)
class WrittenGrid:
    """A grid, and how usual the numbers are that describe it."""

    grid: HashGridConfig
    tier: int
    """0: a usual number (a power of two, a growth of two decimals) · 1: a round one · 2: any whole number of nodes."""
    said: dict[str, Any]
    """The entries of the description's ``hash`` that say it."""

    @property
    def order(self) -> tuple[int, bool]:
        """Where it is listed: of as usual numbers, growths of two decimals last, because there are so many."""
        return self.tier, round(self.grid.per_level_scale, 2) == self.grid.per_level_scale


@dataclass(frozen=True)
class GridSpace:
    """Grids of one number of levels and features, whose table size and width are those of the checkpoint."""

    intervals: tuple[GridInterval, ...]
    features_per_level: int
    interpolation: Interpolation
    writes_growth: bool
    """Whether the family's configurations give the growth itself, and not the finest resolution."""
    top: int | None = None
    growth: float | None = None
    """What the settings or the description say of them."""
    is_told: bool = False
    """Whether the file itself says how long each level is: the layout of its rows is then the family's affair."""

    @cached_property
    def written(self) -> tuple[WrittenGrid, ...]:
        """The grids that somebody would have written, the most usual first. Each has the table's number of entries."""
        found: dict[object, WrittenGrid] = {}
        for interval in self.intervals:
            for base in self._bases(interval):
                for tier, growth, said in self._growths(interval, base):
                    grid = self._grid(interval, base, growth)
                    if grid is not None:
                        extra = 0 if base in _USUAL_BASES or not interval.base_is_free else 2
                        entry = WrittenGrid(grid, max(tier, extra), self._said(interval, base) | said)
                        found.setdefault((grid, interval), entry)
        return tuple(sorted(found.values(), key=lambda entry: entry.order))

    def _bases(self, interval: GridInterval) -> tuple[int, ...]:
        if not interval.base_is_free:
            return (interval.base_resolution,)
        usual = [base for base in _USUAL_BASES if base >= interval.base_resolution]
        others = range(interval.base_resolution, min(MAX_BASE, max(129, interval.base_resolution + 1)))
        return tuple(dict.fromkeys((*usual, *others)))

    def _said(self, interval: GridInterval, base: int) -> dict[str, Any]:
        return {
            "levels": interval.levels,
            "features_per_level": self.features_per_level,
            "log2_table_size": interval.log2_table_size,
            "base_resolution": base,
        }

    def _growths(self, interval: GridInterval, base: int) -> Iterator[tuple[int, float, dict[str, Any]]]:
        """Tier, growth and the entry that says it, of all that somebody would write within the interval."""
        if interval.levels == 1:
            yield 0, 1.0, {"per_level_scale": 1.0}
        elif self.growth is not None:
            yield 0, self.growth, {"per_level_scale": self.growth}
        elif self.top is not None:
            if self.top > base:
                yield 0, _growth_to(self.top, base, interval.levels), {"top_resolution": self.top}
        elif interval.resolutions is not None:
            yield 0, interval.lowest, {"per_level_scale": interval.lowest}
        else:
            for tier, growth, said in _tops(interval, base):
                yield tier + (self.writes_growth and tier > 0), growth, said
            if self.writes_growth and (base in _USUAL_BASES or not interval.base_is_free):
                yield from _short_growths(interval)

    def _grid(self, interval: GridInterval, base: int, growth: float) -> HashGridConfig | None:
        """The grid of this growth, by another machine's rounding where only that gives the table's size."""
        if not 1.0 <= growth <= MAX_GROWTH:
            return None
        if not interval.lowest * (1.0 - _EDGE) <= growth <= interval.highest * (1.0 + _EDGE):
            return None
        values = (interval.levels, self.features_per_level, interval.log2_table_size, base)
        grid = HashGridConfig(*values, growth, interval.resolutions, interpolation=self.interpolation)
        if self.is_told or interval.base_is_free or interval.resolutions is not None:
            return grid
        wanted = replace(grid, per_level_scale=interval.lowest).entries
        try:
            return grid.with_entry_count(wanted)
        except FieldFormatError:
            return None


def _tops(interval: GridInterval, base: int) -> Iterator[tuple[int, float, dict[str, Any]]]:
    steps = interval.levels - 1
    lowest = max(base + 1, math.ceil(base * (interval.lowest * (1.0 - _EDGE)) ** steps))
    highest = min(_MAX_TOP, math.floor(base * min(interval.highest * (1.0 + _EDGE), MAX_GROWTH) ** steps))
    powers = [1 << k for k in range(lowest.bit_length() - 1, _MAX_TOP.bit_length()) if lowest <= 1 << k <= highest]
    listed = dict.fromkeys(powers, 0)
    if not interval.base_is_free:
        for unit in (256, 100, 64, 50, 32, 10, 1):
            several = range(-(-lowest // unit) * unit, highest + 1, unit)
            if len(listed) + len(several) <= _MOST_ROUND:
                listed = {**dict.fromkeys(several, 1 if unit > 1 else 2), **listed}
        if not any(listed.values()):
            listed = {**dict.fromkeys(_two_digits(lowest, highest), 1), **listed}
    for top, tier in listed.items():
        yield tier, _growth_to(top, base, interval.levels), {"top_resolution": top}


def _two_digits(lowest: int, highest: int) -> list[int]:
    """Numbers of two digits and zeros, in a range that is too wide for closer ones."""
    units = (10**k for k in range(len(str(highest)) - 1))
    return [number for unit in units for number in range(10 * unit, 100 * unit, unit) if lowest <= number <= highest]


def _short_growths(interval: GridInterval) -> Iterator[tuple[int, float, dict[str, Any]]]:
    lowest, highest = interval.lowest * (1.0 - _EDGE), min(interval.highest * (1.0 + _EDGE), 2.5)
    for growth in _COPIED:
        if lowest <= growth <= highest:
            yield 0, growth, {"per_level_scale": growth}
    for decimals, tier in ((2, 0), (3, 1), (4, 2)):
        first, last = math.ceil(lowest * 10**decimals), math.floor(highest * 10**decimals)
        if decimals > 2 and interval.base_is_free:
            return
        if last - first > _MOST_ROUND * (1 if decimals > 2 else 4):
            return
        for number in range(max(first, 10**decimals + 1), last + 1):
            if decimals == 2 or number % 10:
                growth = number / 10**decimals
                yield tier, growth, {"per_level_scale": growth}


def _growth_to(top: int, base: int, levels: int) -> float:
    """The growth under which the finest of ``levels`` has ``top`` nodes along an edge."""
    return math.exp((math.log(top) - math.log(base)) / max(levels - 1, 1))
