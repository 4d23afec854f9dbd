"""Which hash grid a bare table of parameters belongs to: the usual configurations, compared by their size."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from regnf_core.errors import FieldFormatError
from regnf_core.fields.hash_grid_config import HashGridConfig, Interpolation
from regnf_core.importing.upload_description import GridDescription

_LOG2_SIZES = (19, *(size for size in range(24, 7, -1) if size != 19))
_MAX_LEVELS = 32


@dataclass(frozen=True)
class GridHabits:
    """What a family's trainers usually set, the most usual first. resolutions: (base, top) nodes along an edge."""

    features_per_level: tuple[int, ...]
    resolutions: tuple[tuple[int, int], ...]
    interpolation: Interpolation


@dataclass(frozen=True)
class FoundGrid:
    """The chosen configuration, and whether others of the same size would have fitted too."""

    config: HashGridConfig
    ambiguous: bool


def find_grid(parameters: int, width: int, habits: GridHabits, wanted: GridDescription) -> FoundGrid:
    """The grid with ``parameters`` numbers whose encoding is ``width`` wide; ``wanted`` narrows the search.

    Exact layouts come first; then those in which another machine's rounding moved a level by one node.
    Raises FieldFormatError (HASH_GRID_NOT_RECOGNISED).
    """
    candidates = list(_candidates(parameters, width, habits, wanted))
    fitting = [c for c in candidates if c.entries * c.features_per_level == parameters]
    if not fitting:
        fitting = [c for c in (_rounded(c, parameters) for c in candidates) if c is not None]
    if not fitting:
        message = f"no usual hash grid has {parameters} parameters and {width} features; describe it under 'hash'"
        raise FieldFormatError(message, reason="HASH_GRID_NOT_RECOGNISED")
    first = fitting[0]
    ambiguous = any(_shape(other) != _shape(first) for other in fitting[1:])
    return FoundGrid(first, ambiguous)


def _candidates(parameters: int, width: int, habits: GridHabits, wanted: GridDescription) -> Iterator[HashGridConfig]:
    for features in _choices(wanted.features_per_level, habits.features_per_level):
        levels, rest = divmod(width, features)
        if rest or parameters % features or not 1 <= levels <= _MAX_LEVELS:
            continue
        for base, top in _resolutions(habits, wanted):
            for log2_size in _LOG2_SIZES:
                yield HashGridConfig.from_top_resolution(
                    top,
                    levels=levels,
                    features_per_level=features,
                    log2_table_size=log2_size,
                    base_resolution=base,
                    interpolation=wanted.interpolation or habits.interpolation,
                )


def _choices(wanted: int | None, usual: Sequence[int]) -> Sequence[int]:
    return usual if wanted is None else (wanted,)


def _resolutions(habits: GridHabits, wanted: GridDescription) -> list[tuple[int, int]]:
    pairs = dict.fromkeys((wanted.base_resolution or b, wanted.top_resolution or t) for b, t in habits.resolutions)
    return [(base, top) for base, top in pairs if top >= base]


def _rounded(config: HashGridConfig, parameters: int) -> HashGridConfig | None:
    try:
        return config.with_entry_count(parameters // config.features_per_level)
    except FieldFormatError:
        return None


def _shape(config: HashGridConfig) -> tuple[int, int, int, float]:
    """What distinguishes functions: another table cap that no level reaches does not."""
    return config.levels, config.features_per_level, config.base_resolution, config.per_level_scale
