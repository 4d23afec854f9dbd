"""The arithmetic of shapes: what small values that depend on no point are, computed beforehand with numpy.

The same rules as those of the evaluation: whole numbers are int64 and wrap, a division cuts towards zero.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from regnf_core.schema.onnx_operators import MAX_ELEMENTS

# What is known of a value in a graph before the graph is run: its shape, its type, and perhaps its numbers.

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


_CAST: dict[int, Any] = {1: np.float32, 10: np.float32, 11: np.float32, 16: np.float32, 9: np.bool_}


def _div(a: Array, b: Array) -> Array:
    if "f" in (a.dtype.kind, b.dtype.kind):
        return np.asarray(a / b)
    if not np.all(b):
        raise ValueError("a division by zero")
    down = np.floor_divide(a, b)
    return np.asarray(down + ((np.remainder(a, b) != 0) & ((a < 0) != (b < 0))))


def _mod(a: Array, b: Array) -> Array:
    if "f" not in (a.dtype.kind, b.dtype.kind) and not np.all(b):
        raise ValueError("a division by zero")
    return np.asarray(np.remainder(a, b))


_ELEMENTWISE: dict[str, Callable[..., Any]] = {
    "Abs": np.abs,
    "Add": np.add,
    "And": np.logical_and,
    "Ceil": np.ceil,
    "Div": _div,
    "Equal": np.equal,
    "Floor": np.floor,
    "Greater": np.greater,
    "GreaterOrEqual": np.greater_equal,
    "Identity": np.asarray,
    "Less": np.less,
    "LessOrEqual": np.less_equal,
    "Mod": _mod,
    "Mul": np.multiply,
    "Neg": np.negative,
    "Not": np.logical_not,
    "Or": np.logical_or,
    "Round": np.round,
    "Sqrt": np.sqrt,
    "Sub": np.subtract,
    "Where": np.where,
}
_FOLDED: dict[str, Callable[..., Any]] = {"Max": np.maximum, "Min": np.minimum, "Sum": np.add}
_REDUCED: dict[str, Callable[..., Any]] = {
    "ReduceMax": np.max,
    "ReduceMin": np.min,
    "ReduceProd": np.prod,
    "ReduceSum": np.sum,
}


def computed(op: str, attributes: dict[str, Any], inputs: list[Value | None], result: Value) -> Value:
    """``result`` with its numbers, if they follow from numbers that are known. Raises ValueError."""
    arrays = [None if value is None else value.numbers for value in inputs]
    if attributes.get("fmod", 0):  # another rule for signs
        return result
    told = all(array is not None for value, array in zip(inputs, arrays, strict=True) if value is not None)
    if not inputs or not told or result.size > MAX_KNOWN or result.numbers is not None:
        return result
    with np.errstate(all="ignore"):
        found = _numbers(op, attributes, [np.asarray(array) for array in arrays if array is not None], result.shape)
    if found is None:
        return result
    settled = known(found.reshape(result.shape))
    return Value(result.shape, settled.kind, False, settled.numbers)


def _numbers(op: str, attributes: dict[str, Any], arrays: list[Array], shape: tuple[int, ...]) -> Array | None:
    if op in _ELEMENTWISE:
        return np.asarray(_ELEMENTWISE[op](*arrays))
    if op in _FOLDED:
        first, *rest = arrays
        for array in rest:
            first = _FOLDED[op](first, array)
        return first
    if op in _REDUCED:
        axes = arrays[1].reshape(-1).tolist() if len(arrays) > 1 else list(attributes.get("axes", ()))
        return np.asarray(_REDUCED[op](arrays[0], axis=tuple(axes) if axes else None))
    match op:
        case "Cast":
            return arrays[0].astype(_CAST.get(int(attributes["to"]), np.int64))
        case "Concat":
            return np.concatenate(arrays, axis=int(attributes["axis"]))
        case "Expand" | "ConstantOfShape":
            source = arrays[0] if op == "Expand" else arrays[1] if len(arrays) > 1 else np.zeros(1, np.float32)
            return np.broadcast_to(source, shape)
        case "Gather":
            return np.take(arrays[0], arrays[1], axis=int(attributes.get("axis", 0)))
        case "Tile":
            return np.tile(arrays[0], arrays[1].reshape(-1).tolist())
        case "Transpose":
            return np.transpose(arrays[0], attributes.get("perm"))
        case "Reshape" | "Flatten" | "Squeeze" | "Unsqueeze":
            return arrays[0]
    return None


def range_of(inputs: list[Value | None]) -> Array | None:
    """The numbers of a Range, None if they are many; its length is :func:`range_length`."""
    start, _, step = (np.asarray(needed(value).numbers).reshape(()) for value in inputs)
    length = range_length(inputs)
    return None if length > MAX_KNOWN else start + step * np.arange(length, dtype=start.dtype)


def range_length(inputs: list[Value | None]) -> int:
    """How many numbers from start to limit. Raises ValueError."""
    if any(needed(value).numbers is None or needed(value).size != 1 for value in inputs):
        raise ValueError("the size of its result cannot be told beforehand")
    start, limit, step = (np.asarray(needed(value).numbers).reshape(()).item() for value in inputs)
    if step == 0 or not all(np.isfinite((start, limit, step))):
        raise ValueError("a range without a step, or without an end")
    exact = (limit - start) / step
    if not np.isfinite(exact) or exact > 2**53:
        raise ValueError("a range without an end")
    return max(int(np.ceil(exact)), 0)
