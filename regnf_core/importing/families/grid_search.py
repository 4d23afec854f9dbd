"""Which hash grids a bare table of parameters may belong to: every one that its size and the width allow."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from regnf_core.errors import FieldFormatError
from regnf_core.importing.families.grid_solver import MAX_BASE, GridInterval, solve
from regnf_core.importing.families.grid_space import GridSpace
from regnf_core.importing.families.shared import contradiction
from regnf_core.importing.upload_description import GridDescription
from regnf_core.schema.hash_grid_config import MAX_GROWTH, HashGridConfig, Interpolation

_MAX_LEVELS = 32
_FEATURES = (2, 4, 8, 1)
"""All that tiny-cuda-nn takes."""
_LOG2_SIZES = range(3, 25)
_BASES = range(2, MAX_BASE + 1)


@dataclass(frozen=True)
class GridHabits:
    """What holds for all of a family's configurations. features_per_level: the usual ones, the most usual first."""

    features_per_level: tuple[int, ...]
    interpolation: Interpolation
    writes_growth: bool = False
    """Whether configurations give the growth itself, and not the finest resolution."""


def find_spaces(parameters: int, width: int, habits: GridHabits, given: GridDescription) -> tuple[GridSpace, ...]:
    """The grids with ``parameters`` numbers whose encoding is ``width`` wide, the most usual features first.

    What ``given`` says is taken as it is. Raises FieldFormatError: SETTINGS_CONTRADICT_TENSORS where nothing of what it
    says fits the tensors, HASH_GRID_NOT_RECOGNIZED where no grid at all does.
    """
    _require_width(width, given)
    spaces = tuple(_spaces(parameters, width, habits, given))
    if spaces:
        return spaces
    said = {name: value for name, value in vars(given).items() if value is not None and name != "interpolation"}
    if said:
        raise contradiction("hash", said, f"{parameters} numbers and {width} columns")
    message = f"no hash grid has {parameters} parameters and {width} features"
    raise FieldFormatError(message, reason="HASH_GRID_NOT_RECOGNIZED")


def grid_name(config: HashGridConfig) -> str:
    """A few words that tell one layout from another."""
    resolutions = config.level_resolutions()
    top = round(config.scales()[-1]) + 1
    name = f"{config.levels} levels of {config.features_per_level}, {resolutions[0]} to {top} nodes"
    strides = config.level_strides()
    moved = [f"level {i} by {strides[i]}" for i, nodes in enumerate(resolutions) if strides[i] != nodes]
    return f"{name}, indexed {' and '.join(moved)}" if moved else name


def _require_width(width: int, given: GridDescription) -> None:
    levels, features = given.levels, given.features_per_level
    if levels is not None and features is not None and levels * features != width:
        raise contradiction("hash.levels x hash.features_per_level", levels * features, f"{width} columns")


def _spaces(parameters: int, width: int, habits: GridHabits, given: GridDescription) -> Iterator[GridSpace]:
    for features in _features(habits, given):
        levels, rest = divmod(width, features)
        if rest or parameters % features or not 1 <= levels <= _MAX_LEVELS or given.levels not in (None, levels):
            continue
        intervals = _intervals(parameters // features, levels, given)
        if intervals:
            space = GridSpace(
                intervals,
                features,
                given.interpolation or habits.interpolation,
                habits.writes_growth,
                given.top_resolution,
                given.per_level_scale,
            )
            if space.written:
                yield space


def _features(habits: GridHabits, given: GridDescription) -> Sequence[int]:
    if given.features_per_level is not None:
        return (given.features_per_level,)
    return tuple(dict.fromkeys((*habits.features_per_level, *_FEATURES)))


def _intervals(entries: int, levels: int, given: GridDescription) -> tuple[GridInterval, ...]:
    sizes = _LOG2_SIZES if given.log2_table_size is None else (given.log2_table_size,)
    bases = _BASES if given.base_resolution is None else (given.base_resolution,)
    if given.per_level_scale is not None:
        return solve(entries, levels, sizes, bases, (given.per_level_scale,) * len(bases))
    if given.top_resolution is not None:
        steps = max(levels - 1, 1)
        fitting = [b for b in bases if b <= given.top_resolution <= b * MAX_GROWTH**steps]
        return solve(entries, levels, sizes, fitting, [(given.top_resolution / b) ** (1.0 / steps) for b in fitting])
    return solve(entries, levels, sizes, bases)
