"""Which hash grids a bare table of parameters may belong to: the usual configurations, compared by their size."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from regnf_core.errors import FieldFormatError
from regnf_core.importing.upload_description import GridDescription
from regnf_core.schema.hash_grid_config import MAX_GROWTH, HashGridConfig, Interpolation

MAX_GRIDS = 24
"""Most configurations that are worth trying out."""
_LOG2_SIZES = (19, *(size for size in range(24, 7, -1) if size != 19))
_MAX_LEVELS = 32


@dataclass(frozen=True)
class GridHabits:
    """What a family's trainers usually set, the most usual first. resolutions: (base, top) nodes along an edge."""

    features_per_level: tuple[int, ...]
    resolutions: tuple[tuple[int, int], ...]
    interpolation: Interpolation


def find_grids(parameters: int, width: int, habits: GridHabits, given: GridDescription) -> tuple[HashGridConfig, ...]:
    """The grids with ``parameters`` numbers whose encoding is ``width`` wide, the most usual first, at most MAX_GRIDS.

    ``given`` narrows the search. Exact layouts are preferred to those in which another machine's rounding moved a
    level by one node. At the end come the ways in which the training device may have indexed the same tables.
    Raises FieldFormatError (HASH_GRID_NOT_RECOGNIZED).
    """
    candidates = list(_candidates(parameters, width, habits, given))
    fitting = [c for c in candidates if c.entries * c.features_per_level == parameters]
    if not fitting:
        fitting = [c for c in (_rounded(c, parameters) for c in candidates) if c is not None]
    if not fitting:
        message = f"no usual hash grid has {parameters} parameters and {width} features; describe it under 'hash'"
        raise FieldFormatError(message, reason="HASH_GRID_NOT_RECOGNIZED")
    distinct: dict[object, HashGridConfig] = {}
    for config in fitting:
        distinct.setdefault(_function(config), config)
    indexed = itertools.chain.from_iterable(config.stride_variants() for config in distinct.values())
    return tuple(itertools.islice(itertools.chain(distinct.values(), indexed), MAX_GRIDS))


def grid_name(config: HashGridConfig) -> str:
    """A few words that tell one layout from another."""
    resolutions = config.level_resolutions()
    name = f"{config.levels} levels of {config.features_per_level}, {resolutions[0]} to {resolutions[-1]} nodes"
    strides = config.level_strides()
    moved = [f"level {i} by {strides[i]}" for i, nodes in enumerate(resolutions) if strides[i] != nodes]
    return f"{name}, indexed {' and '.join(moved)}" if moved else name


def _candidates(parameters: int, width: int, habits: GridHabits, given: GridDescription) -> Iterator[HashGridConfig]:
    for features in _choices(given.features_per_level, habits.features_per_level):
        levels, rest = divmod(width, features)
        if rest or parameters % features or not 1 <= levels <= _MAX_LEVELS:
            continue
        for base, top in _resolutions(habits, given):
            if levels > 1 and top > base * MAX_GROWTH ** (levels - 1):
                continue
            for log2_size in _LOG2_SIZES:
                yield HashGridConfig.from_top_resolution(
                    top,
                    levels=levels,
                    features_per_level=features,
                    log2_table_size=log2_size,
                    base_resolution=base,
                    interpolation=given.interpolation or habits.interpolation,
                )


def _choices(given: int | None, usual: Sequence[int]) -> Sequence[int]:
    return usual if given is None else (given,)


def _resolutions(habits: GridHabits, given: GridDescription) -> list[tuple[int, int]]:
    pairs = dict.fromkeys((given.base_resolution or b, given.top_resolution or t) for b, t in habits.resolutions)
    return [(base, top) for base, top in pairs if top >= base]


def _rounded(config: HashGridConfig, parameters: int) -> HashGridConfig | None:
    try:
        return config.with_entry_count(parameters // config.features_per_level)
    except FieldFormatError:
        return None


def _function(config: HashGridConfig) -> object:
    """What distinguishes functions: another table cap that no level reaches does not."""
    growth = config.per_level_scale if config.levels > 1 else 1.0
    return config.levels, config.features_per_level, config.base_resolution, growth, config.level_entries()
