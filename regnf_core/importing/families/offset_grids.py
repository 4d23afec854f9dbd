"""Hash grids whose file tells where each level begins: those of torch-ngp's kernel, which other trainers took over.

A level of resolution r has r + 1 nodes along an edge, and rows as long.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import Float32Array, require_shape, tensor_error
from regnf_core.importing.families.converted import Reading
from regnf_core.importing.families.grid_search import finest_of, grid_readings, most_usual
from regnf_core.importing.families.grid_space import GridInterval, GridSpace
from regnf_core.importing.families.layers import contradiction
from regnf_core.importing.tensor_source import TensorSource, lookup
from regnf_core.importing.upload_description import GridDescription
from regnf_core.schema.hash_grid_config import MAX_GROWTH, HashGridConfig, Interpolation

_MAX_LOG2_SIZE = 24
_MOST = 32
_ALIGNMENT = 8
_PRIMES = (1, 2654435761, 805459861)
_DOUBTFUL = 1e-5
"""Relative distance from a whole number within which single and double precision may round otherwise."""


@dataclass(frozen=True)
class OffsetTable:
    """table: (entries, features), level by level · sizes: entries a level."""

    table: Float32Array
    sizes: tuple[int, ...]

    @property
    def features(self) -> int:
        """Numbers an entry."""
        return int(self.table.shape[1])

    @property
    def width(self) -> int:
        """Columns of the encoding."""
        return len(self.sizes) * self.features


def read_table(state: dict[str, Any], source: TensorSource, prefix: str, given: GridDescription) -> OffsetTable:
    """``<prefix>embeddings``, divided into levels by ``<prefix>offsets``.

    Raises FieldFormatError: TENSOR_SHAPE, SETTINGS_CONTRADICT_TENSORS and what TensorSource raises.
    """
    name, told = f"{prefix}embeddings", f"{prefix}offsets"
    table = source.array(name, lookup(state, name))
    require_shape(name, table, (None, None))
    offsets = source.integers(told, lookup(state, told))
    sizes = tuple(int(n) for n in np.diff(offsets)) if offsets.ndim == 1 else ()
    if not sizes or offsets[0] != 0 or offsets[-1] != len(table) or min(sizes) <= 0:
        raise tensor_error(f"{told} do not divide {name} into levels", "TENSOR_SHAPE")
    features = table.shape[1]
    if len(sizes) > _MOST or not 1 <= features <= _MOST:
        raise tensor_error(f"{name}: {len(sizes)} levels of {features} features", "TENSOR_SHAPE")
    for entry, found in (("levels", len(sizes)), ("features_per_level", features)):
        said = getattr(given, entry)
        if said not in (None, found):
            raise contradiction(f"hash.{entry}", said, found)
    return OffsetTable(table, sizes)


def offset_readings(
    table: OffsetTable,
    layers: dict[str, Float32Array],
    entries: dict[str, Any],
    given: GridDescription,
    interpolation: Interpolation = "linear",
) -> tuple[Reading, ...]:
    """One reading a grid whose levels have the table's sizes, the most usual first.

    layers: tensors by name · entries: the rest of the description, with its kind · interpolation: the trainer's own.
    Raises FieldFormatError (HASH_GRID_NOT_RECOGNIZED) where no grid has such levels.
    """
    space = _space(table.sizes, table.features, given, given.interpolation or interpolation)
    readings = []
    for written in space.written if space is not None else ():
        fitted = _fitted(table, written.grid)
        if fitted is not None:
            (reading,) = grid_readings(fitted[1], (fitted[0],), layers, entries)
            readings.append(replace(reading, say={"hash": written.said}, tier=written.tier, scale=finest_of(fitted[0])))
    if not readings:
        raise not_recognized(f"no hash grid has levels of {table.sizes} entries")
    return most_usual(readings)


def not_recognized(message: str) -> FieldFormatError:
    """The refusal of a table that no hash grid has."""
    return FieldFormatError(message, reason="HASH_GRID_NOT_RECOGNIZED")


def _fitted(table: OffsetTable, grid: HashGridConfig) -> tuple[HashGridConfig, Float32Array] | None:
    """The grid and the table as a field has them, or None where the levels have other sizes.

    The trainer lays out the table in double precision and its kernel finds rows in single: where a resolution is
    whole, one may count a node more than the other. Such a level is laid out anew, as the kernel finds its rows.
    """
    rows = [math.ceil(scale) + 2 for scale in grid.scales()]
    parts, start, cap = [], 0, 1 << grid.log2_table_size
    for size, row, scale in zip(table.sizes, rows, grid.scales(), strict=True):
        part, start = table.table[start : start + size], start + size
        nodes = round(size ** (1 / 3))
        is_full = size == cap and row**3 > cap
        if not is_full and not 0 <= size - nodes**3 < _ALIGNMENT:
            return None
        if not is_full and row != nodes:
            if abs(row - nodes) > 1 or abs(scale - round(scale)) > _DOUBTFUL * scale or row**3 > cap:
                return None
            part = part[_rows_of(row, size)]
        parts.append(np.pad(part, ((0, -len(part) % _ALIGNMENT), (0, 0))))
    laid_out = replace(grid, resolutions=tuple(rows))
    whole = np.concatenate(parts)
    return (laid_out, whole) if laid_out.entries == len(whole) else None


def _rows_of(row: int, size: int) -> npt.NDArray[np.int64]:
    """Where in a level of ``size`` entries the kernel finds the nodes of a lattice of ``row`` along an edge, x
    fastest."""
    z, y, x = (axis.ravel() for axis in np.meshgrid(*[np.arange(row)] * 3, indexing="ij"))
    if row**3 <= size:
        return np.arange(row**3) % size
    return np.asarray(((x * _PRIMES[0]) ^ (y * _PRIMES[1]) ^ (z * _PRIMES[2])) % (1 << 32) % size)


def _space(
    sizes: Sequence[int], features: int, given: GridDescription, interpolation: Interpolation
) -> GridSpace | None:
    """The grids whose levels have these sizes, which tell the nodes along an edge of all that are not full."""
    log2_size = max(3, math.ceil(math.log2(max(sizes)))) if given.log2_table_size is None else given.log2_table_size
    if log2_size > _MAX_LOG2_SIZE:
        raise not_recognized(f"a level of {max(sizes)} entries is larger than any that is taken")
    nodes = [round(size ** (1 / 3)) for size in sizes if size < 1 << log2_size]  # at most 7 more than the cube
    base = nodes[0] - 1 if nodes else given.base_resolution
    least = base if base is not None else max(2, math.floor((1 << log2_size) ** (1 / 3)) - 1)
    low, high = 1.0, MAX_GROWTH
    for level, count in enumerate(nodes[1:], start=1):
        low = max(low, ((count - 2) / least) ** (1 / level))
        high = min(high, ((count - 1) / least) ** (1 / level))
    if least < 2 or low > high or given.base_resolution not in (None, base):
        return None
    interval = GridInterval(len(sizes), log2_size, least, low, high, base_is_free=base is None)
    said = (given.top_resolution, given.per_level_scale)
    return GridSpace((interval,), features, interpolation, False, *said, is_told=True)
