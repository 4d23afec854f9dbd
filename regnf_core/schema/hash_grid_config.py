"""The layout of a multi-resolution hash grid: how many entries each level has, and where they are in the table.

Torch-free, so that a file's shapes can be checked before anything heavy is loaded. The layout is the one that
tiny-cuda-nn writes (Müller et al. 2022, "Instant neural graphics primitives"), float32 rounding included: scales are
computed in single precision there, and whether ``ceil`` sees 63.0 or 63.000004 decides a level's row length.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Gt, Le

from regnf_core.errors import FieldFormatError
from regnf_core.schema.closed import Closed

Interpolation = Literal["linear", "smoothstep"]
_ENTRY_ALIGNMENT = 8
MAX_GROWTH = 8
"""Of neighboring levels' resolutions, as far as the safe format takes it. A whole number, as other bounds of 8 are:
equal annotations are one object, and the contract would print 8 or 8.0 by which module was loaded first."""
_MAX_PATTERNS = 4096
"""Most patterns of rounding that are tried."""
_ROUNDING_REACH = 1e-3
"""A scale this close to a whole number may be rounded either way by another machine's exp2f."""


@dataclass(frozen=True)
class HashGridConfig(Closed):
    """A grid of ``levels`` lattices over the unit cube, each with at most 2^log2_table_size entries of features.

    A level whose lattice fits into its part of the table is *dense* (one entry a node), a finer one is *hashed*.
    """

    levels: Annotated[int, Ge(1), Le(32)] = 16
    features_per_level: Annotated[int, Ge(1), Le(32)] = 2
    log2_table_size: Annotated[int, Ge(3), Le(24)] = 19
    base_resolution: Annotated[int, Ge(2), Le(1024)] = 16
    per_level_scale: Annotated[float, Ge(1), Le(MAX_GROWTH)] = 1.3819128799677762
    """Ratio of the resolutions of neighboring levels."""
    resolutions: tuple[Annotated[int, Gt(1), Le(1 << 24)], ...] | None = None
    """Nodes along an edge, per level, where they must differ from the computed ones (see :meth:`with_entry_count`)."""
    strides: tuple[Annotated[int, Gt(1), Le(1 << 24)], ...] | None = None
    """Nodes along an edge by which a level's rows were indexed in training, where that device rounded otherwise than
    the machine that laid out the table (see :meth:`stride_variants`)."""
    interpolation: Interpolation = "smoothstep"

    def __post_init__(self) -> None:
        for name, values in (("resolutions", self.resolutions), ("strides", self.strides)):
            if values is not None and len(values) != self.levels:
                message = f"hash grid has {self.levels} levels and {len(values)} {name}"
                raise FieldFormatError(message, reason="FIELD_SHAPES_MISMATCH")

    @classmethod
    def from_top_resolution(cls, top_resolution: int, **values: Any) -> HashGridConfig:
        """A config whose finest level has ``top_resolution`` nodes along an edge; ``values`` are the other fields."""
        config = cls(**values)
        steps = max(config.levels - 1, 1)
        growth = math.exp((math.log(top_resolution) - math.log(config.base_resolution)) / steps)
        return replace(config, per_level_scale=growth)

    @property
    def width(self) -> int:
        """Number of features of an encoded point: levels x features_per_level."""
        return self.levels * self.features_per_level

    def scales(self) -> tuple[float, ...]:
        """Cells along an edge of the unit cube, per level: exp2(l log2(growth)) base - 1, in float32."""
        return _scales(self.levels, self.base_resolution, self.per_level_scale)

    def described(self) -> dict[str, Any]:
        """The entries of a description's ``hash`` that say this config."""
        return {entry.name: getattr(self, entry.name) for entry in fields(self)}

    def level_resolutions(self) -> tuple[int, ...]:
        """Nodes along an edge, per level."""
        if self.resolutions is not None:
            return self.resolutions
        return tuple(math.ceil(scale) + 1 for scale in self.scales())

    def level_entries(self) -> tuple[int, ...]:
        """Table entries per level: the lattice's nodes, rounded up to a multiple of 8, at most 2^log2_table_size."""
        return tuple(self._entries_of(res) for res in self.level_resolutions())

    def level_strides(self) -> tuple[int, ...]:
        """Nodes along an edge by which each level's rows are indexed."""
        return self.level_resolutions() if self.strides is None else self.strides

    def level_is_dense(self) -> tuple[bool, ...]:
        """Whether each level keeps one entry a node (else its nodes are hashed)."""
        pairs = zip(self.level_resolutions(), self.level_entries(), strict=True)
        return tuple(res**3 <= entries for res, entries in pairs)

    @property
    def entries(self) -> int:
        """Rows of the whole table, all levels."""
        return sum(self.level_entries())

    def with_entry_count(self, entries: int) -> HashGridConfig:
        """This config with the per-level rounding under which the table has ``entries`` rows.

        Where base x growth^l is a whole number, one machine's exp2f gives r nodes and another's r + 1. The stored
        table shows which: the pattern with the fewest changes that matches wins.

        Raises FieldFormatError (FIELD_SHAPES_MISMATCH) when no pattern matches.
        """
        usual, total = self.level_resolutions(), self.entries
        if total == entries:
            return self
        counts = {
            level: (self._entries_of(other) - self._entries_of(usual[level]), other)
            for level, other in self._otherwise_rounded().items()
        }
        chosen = _fewest({level: more for level, (more, _) in counts.items() if more}, entries - total)
        if chosen is not None:
            others = {level: other for level, (_, other) in counts.items()}
            return replace(self, resolutions=_with_others(usual, others, chosen))
        message = f"hash table has {entries} entries, its description gives {total}"
        raise FieldFormatError(message, reason="FIELD_SHAPES_MISMATCH")

    def _entries_of(self, nodes: int) -> int:
        return min(-(-(nodes**3) // _ENTRY_ALIGNMENT) * _ENTRY_ALIGNMENT, 1 << self.log2_table_size)

    def stride_variants(self) -> Iterator[HashGridConfig]:
        """This table indexed by other roundings of its dense, doubtful levels, fewest changes first; not this config.

        The table's length shows how its levels were laid out, but not how the device that trained it computed a row.
        """
        fits = {
            level: other
            for level, other in self._otherwise_rounded().items()
            if self.level_is_dense()[level] and other**3 <= self.level_entries()[level]
        }
        usual = self.level_resolutions()
        choices = itertools.chain.from_iterable(itertools.combinations(fits, n) for n in range(1, len(fits) + 1))
        for chosen in itertools.islice(choices, _MAX_PATTERNS):
            yield replace(self, strides=_with_others(usual, fits, chosen))

    def _otherwise_rounded(self) -> dict[int, int]:
        """The levels whose resolution hangs on the last bit of exp2f, each with its other resolution."""
        usual = self.level_resolutions()
        doubtful = {}
        for level, scale in enumerate(self.scales()):
            nearest = round(scale)
            if abs(scale - nearest) <= _ROUNDING_REACH * max(1.0, scale / 1000):
                doubtful[level] = nearest + 2 if usual[level] == nearest + 1 else nearest + 1
        return doubtful


@lru_cache(maxsize=4096)
def _scales(levels: int, base_resolution: int, per_level_scale: float) -> tuple[float, ...]:
    log2_growth = np.float32(math.log2(np.float32(per_level_scale)))
    growths = (np.float32(2.0 ** float(np.float32(level) * log2_growth)) for level in range(levels))
    return tuple(float(growth * np.float32(base_resolution) - np.float32(1.0)) for growth in growths)


def _with_others(usual: tuple[int, ...], others: dict[int, int], chosen: tuple[int, ...]) -> tuple[int, ...]:
    """``usual`` with the ``chosen`` levels replaced by their other value."""
    return tuple(others[level] if level in chosen else value for level, value in enumerate(usual))


def _fewest(changes: dict[int, int], total: int) -> tuple[int, ...] | None:
    """The fewest levels whose changes add up to ``total``; None where none do."""
    reached: dict[int, tuple[int, ...]] = {0: ()}
    for level, change in changes.items():
        for before, chosen in list(reached.items()):
            rank = (len(chosen) + 1, (*chosen, level))
            held = reached.get(before + change)
            if (held is None and len(reached) < _MAX_PATTERNS) or (held is not None and rank < (len(held), held)):
                reached[before + change] = rank[1]
    return reached.get(total)


# How sines and cosines of a position are described.


@dataclass(frozen=True)
class PositionalEncodingDescription(Closed):
    """Sines and cosines of the position; see :class:`regnf_core.fields.color_head.PositionalEncoding`."""

    degree: Annotated[int, Ge(0), Le(24)] = 6
    two_pi: bool = False
    used: bool = True
    """False: the network has the columns, but they were always fed zeros."""
    base_frequency: Annotated[float, Ge(1e-6), Le(1e6)] = 1.0
    """A factor of all frequencies."""
    off_axis: bool = False
    """True: of the lengths along 21 directions, those of an icosahedron, in place of the three coordinates."""

    @property
    def width(self) -> int:
        """Columns of the network's input."""
        return 2 * self.degree * (21 if self.off_axis else 3)
