"""Every hash grid whose table has a given number of entries, found by solving and not from a list.

For levels, table cap and base resolution the number of entries never falls as the growth rises. So the growths that
give a number of entries are one interval, whose ends bisection finds, to the last bit of the float32 in which
tiny-cuda-nn computes. Where no growth gives the number, another machine's rounding may have: at the growth where the
number jumps across the wanted one, several levels may have moved at once.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import overload

import numpy as np
from numpy.typing import NDArray

from regnf_core.errors import FieldFormatError
from regnf_core.schema.hash_grid_config import MAX_GROWTH, HashGridConfig

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
    beyond = [base for base in bases if _round_up(base**3) >= cap]
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
        interval.levels,
        1,
        interval.log2_table_size,
        interval.base_resolution,
        interval.lowest,
        interval.resolutions,
    ).level_entries()
    return interval.base_resolution, interval.lowest, interval.highest, sizes


def _growth(bits: int) -> float:
    return float(np.int32(bits).view(np.float32))


def _ints(values: Sequence[int]) -> _Ints:
    return np.array(values, dtype=np.int64)


@overload
def _round_up(nodes: int) -> int: ...
@overload
def _round_up(nodes: _Ints) -> _Ints: ...
def _round_up(nodes: int | _Ints) -> int | _Ints:
    return -(-nodes // _ALIGNMENT) * _ALIGNMENT
