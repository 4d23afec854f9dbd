"""What is known of a value in a graph before the graph is run: its shape, its type, and perhaps its numbers."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from regnf_core.schema.onnx_operators import MAX_ELEMENTS

MAX_KNOWN = 4_096
"""Numbers that are computed beforehand, since shapes may follow from them."""
MAX_RANK = 16

Kind = Literal["b", "i", "f"]
Array = npt.NDArray[Any]
_ORDER = "bif"
_DTYPES: dict[Kind, Any] = {"b": np.bool_, "i": np.int64, "f": np.float32}


@dataclass(frozen=True)
class Value:
    """shape · kind: truth values, whole or real numbers · moving: depends on the points · numbers: None if unknown."""

    shape: tuple[int, ...]
    kind: Kind = "f"
    moving: bool = False
    numbers: Array | None = None

    @property
    def size(self) -> int:
        """How many elements it has."""
        return math.prod(self.shape)

    @property
    def rank(self) -> int:
        """How many axes it has."""
        return len(self.shape)


def known(numbers: Any) -> Value:
    """A value with all its numbers."""
    array = np.asarray(numbers)
    kind: Kind = "b" if array.dtype.kind == "b" else "i" if array.dtype.kind in "iu" else "f"
    array = array.astype(_DTYPES[kind])
    return Value(array.shape, kind, False, array if array.size <= MAX_KNOWN else None)


def made(shape: tuple[int, ...], *sources: Value | None, kind: Kind | None = None) -> Value:
    """A value of unknown numbers that is computed from ``sources``. Raises ValueError for an impossible size."""
    given = [source for source in sources if source is not None]
    if any(extent < 0 for extent in shape) or len(shape) > MAX_RANK:
        raise ValueError("a value of a shape that there is not")
    if math.prod(shape) > MAX_ELEMENTS:
        raise ValueError(f"a value of more than {MAX_ELEMENTS} numbers")
    widest: Kind = max((source.kind for source in given), key=_ORDER.index, default="f")
    return Value(shape, kind or widest, any(source.moving for source in given))


def needed(value: Value | None) -> Value:
    """An input that may not be left out. Raises ValueError."""
    if value is None:
        raise ValueError("an input is left out")
    return value


def whole_numbers(value: Value | None) -> list[int]:
    """Numbers that decide over a shape. Raises ValueError when they cannot be told beforehand."""
    if needed(value).numbers is None:
        raise ValueError("the size of its result cannot be told beforehand")
    numbers = np.asarray(needed(value).numbers).reshape(-1)
    if not np.isfinite(numbers.astype(np.float64)).all():
        raise ValueError("a number of a shape is not finite")
    return [int(number) for number in numbers.tolist()]


def axis_of(axis: int, rank: int) -> int:
    """An axis counted from 0. Raises ValueError where there is none of that number."""
    span = max(rank, 1)
    if not -span <= axis < span:
        raise ValueError(f"axis {axis} of {rank}")
    return axis % span


def broadcast(*shapes: tuple[int, ...]) -> tuple[int, ...]:
    """The common shape. Raises ValueError."""
    found: list[int] = []
    for place in range(max(map(len, shapes), default=0)):
        extents = {shape[-1 - place] for shape in shapes if len(shape) > place} - {1}
        if len(extents) > 1:
            raise ValueError("shapes that do not fit one another")
        found.append(extents.pop() if extents else 1)
    return tuple(reversed(found))


Attributes = dict[str, Any]
Inputs = list[Value | None]
Rule = Callable[[Attributes, Inputs], list[Value]]
"""The results of an operator from its settings and inputs."""


def listed(attributes: Attributes, name: str, inputs: Inputs, position: int) -> list[int] | None:
    """Whole numbers given as an input, or, by older operator sets, as an attribute; None: left out."""
    if position < len(inputs) and inputs[position] is not None:
        return whole_numbers(inputs[position])
    return [int(number) for number in attributes[name]] if name in attributes else None
