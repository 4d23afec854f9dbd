"""The hash grids that a table's size leaves open, and which of them somebody would have put into a configuration."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from regnf_core.errors import FieldFormatError
from regnf_core.schema.hash_grid_config import MAX_GROWTH, HashGridConfig, Interpolation

# Every hash grid whose table has a given number of entries, found by solving and not from a list.
#
# For levels, table cap and base resolution the number of entries never falls as the growth rises. So the growths that
# give a number of entries are one interval, whose ends bisection finds, to the last bit of the float32 in which tiny-
# cuda-nn computes. Where no growth gives the number, another machine's rounding may have: at the growth where the
# number jumps across the wanted one, several levels may have moved at once.

MAX_BASE = 1024
_ALIGNMENT = 8
_ONE, _MOST = (int(np.float32(value).view(np.int32)) for value in (1.0, MAX_GROWTH))
"""The bits of a positive float32 are ordered as the numbers are."""
_JUMP = 2e-6
"""Relative reach about a jump within which levels count as moving at once."""

_Ints = NDArray[np.int64]


@dataclass(frozen=True)
class GridInterval:
    """Grids that differ in growth alone, all of one layout: every growth from ``lowest`` to ``highest``.

    ``resolutions``: per level, where another machine's rounding laid out the table; None where none is needed.
    """

    levels: int
    log2_table_size: int
    base_resolution: int
    lowest: float
    highest: float
    resolutions: tuple[int, ...] | None = None
    base_is_free: bool = False
    """Every level fills its part of the table: the size tells neither growth nor base, which is this one or larger."""


def solve(
    entries: int,
    levels: int,
    log2_sizes: Sequence[int],
    bases: Sequence[int],
    growths: Sequence[float] | None = None,
) -> tuple[GridInterval, ...]:
    """All grids of ``levels`` levels with ``entries`` rows, of these table sizes and bases.

    growths: one for each base, where they are known. Table sizes that no level reaches are one layout, told by the
    smallest of them.
    """
    found: dict[object, GridInterval] = {}
    sizes_in_order = sorted(log2_sizes)
    if entries % levels == 0 and (entries // levels).bit_length() - 1 in sizes_in_order:
        found |= {_function(full): full for full in _full(entries // levels, levels, bases)}
    sizes, starts = _pairs(entries, levels, sizes_in_order, bases)
    if not len(sizes):
        return tuple(found.values())
    known = dict(zip(bases, growths, strict=True)) if growths is not None else {}
    caps = 1 << sizes
    first = _first_at_least(entries, levels, caps, starts)
    beyond = _first_at_least(entries + 1, levels, caps, starts)
    several = _jumping(first, levels, caps, starts) > 1
    for i, (size, base) in enumerate(zip(sizes.tolist(), starts.tolist(), strict=True)):
        low, high = int(first[i]), int(beyond[i]) - 1
        growth = known.get(base)
        interval: GridInterval | None = None
        if growth is not None:
            interval = _rounded(entries, levels, size, base, growth)
        elif low <= high:
            interval = GridInterval(levels, size, base, _growth(low), _growth(high))
        elif several[i] and _ONE < int(first[i]) <= _MOST:
            interval = _rounded(entries, levels, size, base, nearest_written(_growth(int(first[i])), base, levels))
        if interval is not None:
            found.setdefault(_function(interval), interval)
    return tuple(found.values())


def _full(cap: int, levels: int, bases: Sequence[int]) -> Iterator[GridInterval]:
    """The grids all of whose levels have ``cap`` entries, if that is a power of two: one, whatever base and growth."""
    beyond = [base for base in bases if base**3 + _ALIGNMENT > cap]  # rounded up it has cap entries or more
    if cap & (cap - 1) == 0 and beyond:
        yield GridInterval(levels, cap.bit_length() - 1, min(beyond), 1.0, MAX_GROWTH, base_is_free=len(beyond) > 1)


def _pairs(entries: int, levels: int, log2_sizes: Sequence[int], bases: Sequence[int]) -> tuple[_Ints, _Ints]:
    """Table sizes and bases whose coarsest level is not full and leaves room for the others."""
    sizes = [size for size in log2_sizes if levels << size > entries]
    all_sizes, all_bases = (grid.ravel() for grid in np.meshgrid(_ints(sizes), _ints(bases), indexing="ij"))
    coarsest = _round_up(all_bases**3)
    fits = (coarsest < 1 << all_sizes) & (coarsest * levels <= entries)
    return all_sizes[fits], all_bases[fits]


def _first_at_least(entries: int, levels: int, caps: _Ints, bases: _Ints) -> _Ints:
    """Per pair, the bits of the least growth with that many entries; one more than the largest where there is none."""
    low = np.full(len(caps), _ONE, dtype=np.int64)
    high = np.full(len(caps), _MOST + 1, dtype=np.int64)
    while (low < high).any():
        middle = (low + high) // 2
        enough = _count(middle, levels, caps, bases) >= entries
        high = np.where(enough, middle, high)
        low = np.where(enough, low, np.minimum(middle + 1, high))
    return low


def _count(bits: _Ints, levels: int, caps: _Ints, bases: _Ints) -> _Ints:
    """Entries of grids whose growths have these ``bits``: HashGridConfig.entries for many grids at once."""
    return np.asarray(_level_entries(bits, levels, caps, bases).sum(axis=1), dtype=np.int64)


def _jumping(bits: _Ints, levels: int, caps: _Ints, bases: _Ints) -> _Ints:
    """Per pair, how many levels change their number of entries at the growth with these ``bits``, or next to it."""
    reach = int(_JUMP * 2**24)
    before, after = (np.clip(bits + step, _ONE, _MOST) for step in (-reach, reach))
    moved = _level_entries(before, levels, caps, bases) != _level_entries(after, levels, caps, bases)
    return np.asarray(moved.sum(axis=1), dtype=np.int64)


def _level_entries(bits: _Ints, levels: int, caps: _Ints, bases: _Ints) -> _Ints:
    growth = np.minimum(bits, _MOST).astype(np.int32).view(np.float32)
    log2_growth = np.log2(growth.astype(np.float64)).astype(np.float32)
    powers = np.arange(levels, dtype=np.float32) * log2_growth[:, None]
    factors = np.exp2(powers.astype(np.float64)).astype(np.float32)
    scales = factors * bases.astype(np.float32)[:, None] - np.float32(1.0)
    nodes = np.ceil(np.minimum(scales, np.float32(1 << 20))).astype(np.int64) + 1
    return np.asarray(np.minimum(_round_up(nodes**3), caps[:, None]), dtype=np.int64)


def _rounded(entries: int, levels: int, size: int, base: int, growth: float | None) -> GridInterval | None:
    """The grid of this very growth, if it has ``entries``, or another machine's rounding of doubtful levels has."""
    if growth is None or not 1.0 <= growth <= MAX_GROWTH:
        return None
    try:
        grid = HashGridConfig(levels, 1, size, base, growth).with_entry_count(entries)
    except FieldFormatError:
        return None
    return GridInterval(levels, size, base, growth, growth, grid.resolutions)


def nearest_written(growth: float, base: int, levels: int) -> float | None:
    """The growth at this place that makes the finest resolution whole, or has few decimals; None where none does."""
    steps = max(levels - 1, 1)
    top = round(base * growth**steps)
    for candidate in (round(growth, 4), (top / base) ** (1.0 / steps)):
        if abs(candidate / growth - 1.0) < _JUMP and 1.0 <= candidate <= MAX_GROWTH:
            return candidate
    return None


def _function(interval: GridInterval) -> object:
    """What distinguishes layouts: another table cap that no level reaches does not."""
    if interval.levels == 1:
        interval = GridInterval(1, interval.log2_table_size, interval.base_resolution, 1.0, 1.0)
    sizes = HashGridConfig(
        interval.levels, 1, interval.log2_table_size, interval.base_resolution, interval.lowest, interval.resolutions
    ).level_entries()
    return interval.base_resolution, interval.lowest, interval.highest, sizes


def _growth(bits: int) -> float:
    return float(np.int32(bits).view(np.float32))


def _ints(values: Sequence[int]) -> _Ints:
    return np.array(values, dtype=np.int64)


def _round_up(nodes: _Ints) -> _Ints:
    return -(-nodes // _ALIGNMENT) * _ALIGNMENT


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
