"""The shape of the results of operators that move elements about, and of those that say how many there are."""

from __future__ import annotations

import math

import numpy as np

from regnf_core.importing.cost.onnx_numbers import (
    Attributes,
    Inputs,
    Rule,
    Value,
    axis_of,
    broadcast,
    known,
    listed,
    made,
    needed,
    range_length,
    range_of,
)


def _constant(attributes: Attributes, _: Inputs) -> list[Value]:
    for name, dtype in _CONSTANTS.items():
        if name in attributes:
            return [known(np.array(attributes[name], dtype=dtype))]
    raise ValueError("a constant without a value")


def _shape(attributes: Attributes, inputs: Inputs) -> list[Value]:
    shape = needed(inputs[0]).shape
    return [known(np.array(shape[attributes.get("start", 0) : attributes.get("end", len(shape))], dtype=np.int64))]


def _size(_: Attributes, inputs: Inputs) -> list[Value]:
    return [known(needed(inputs[0]).size)]


def _reshape(attributes: Attributes, inputs: Inputs) -> list[Value]:
    value, shape = needed(inputs[0]), listed(attributes, "shape", inputs, 1) or []
    if not attributes.get("allowzero", 0):
        shape = [value.shape[i] if extent == 0 else extent for i, extent in enumerate(shape)]
    if shape.count(-1) == 1:
        rest = -math.prod(shape)
        if rest <= 0 or value.size % rest:
            raise ValueError(f"no shape {shape} for {value.size} numbers")
        shape = [value.size // rest if extent == -1 else extent for extent in shape]
    if any(extent < 0 for extent in shape) or math.prod(shape) != value.size:
        raise ValueError(f"no shape {shape[:8]} for {value.size} numbers")
    return [made(tuple(shape), value)]


def _flatten(attributes: Attributes, inputs: Inputs) -> list[Value]:
    value, axis = needed(inputs[0]), int(attributes.get("axis", 1))
    if not -value.rank <= axis <= value.rank:
        raise ValueError(f"axis {axis} of {value.rank}")
    first = math.prod(value.shape[: axis + value.rank if axis < 0 else axis])
    return [made((first, value.size // max(first, 1)), value)]


def _squeeze(attributes: Attributes, inputs: Inputs) -> list[Value]:
    value, axes = needed(inputs[0]), listed(attributes, "axes", inputs, 1)
    chosen = {axis_of(axis, value.rank) for axis in axes} if axes is not None else None
    if chosen is not None and any(value.shape[axis] != 1 for axis in chosen if value.rank):
        raise ValueError("a squeezed axis is longer than 1")
    gone = chosen if chosen is not None else {axis for axis, extent in enumerate(value.shape) if extent == 1}
    return [made(tuple(extent for axis, extent in enumerate(value.shape) if axis not in gone), value)]


def _unsqueeze(attributes: Attributes, inputs: Inputs) -> list[Value]:
    value, axes = needed(inputs[0]), listed(attributes, "axes", inputs, 1) or []
    rank = value.rank + len(axes)
    chosen = [axis_of(axis, rank) for axis in axes]
    if len(set(chosen)) != len(chosen):
        raise ValueError("an axis is added twice")
    shape = list(value.shape)
    for axis in sorted(chosen):
        shape.insert(axis, 1)
    return [made(tuple(shape), value)]


def _transpose(attributes: Attributes, inputs: Inputs) -> list[Value]:
    value = needed(inputs[0])
    order = [int(axis) for axis in attributes.get("perm", reversed(range(value.rank)))]
    if sorted(order) != list(range(value.rank)):
        raise ValueError("an order of axes that names one twice, or one that there is not")
    return [made(tuple(value.shape[axis] for axis in order), value)]


def _concat(attributes: Attributes, inputs: Inputs) -> list[Value]:
    given = [needed(value) for value in inputs]
    axis = axis_of(int(attributes["axis"]), given[0].rank)
    rests = {value.shape[:axis] + value.shape[axis + 1 :] for value in given}
    if len(rests) != 1 or not given[0].rank:
        raise ValueError("values that cannot be joined")
    whole = sum(value.shape[axis] for value in given)
    return [made((*given[0].shape[:axis], whole, *given[0].shape[axis + 1 :]), *given)]


def _split(attributes: Attributes, inputs: Inputs) -> list[Value]:
    value = needed(inputs[0])
    axis = axis_of(int(attributes.get("axis", 0)), value.rank)
    sizes, length = listed(attributes, "split", inputs, 1), value.shape[axis]
    if sizes is None:
        parts = int(attributes["outputs"])
        each = -(-length // parts)
        sizes = [min(each, length - part * each) for part in range(parts)]
    if sum(sizes) != length:
        raise ValueError("parts that do not add up to the whole")
    return [made((*value.shape[:axis], size, *value.shape[axis + 1 :]), value) for size in sizes]


def _slice(attributes: Attributes, inputs: Inputs) -> list[Value]:
    value, shape = needed(inputs[0]), list(needed(inputs[0]).shape)
    numbers = None if value.numbers is None else value.numbers
    starts = listed(attributes, "starts", inputs, 1) or []
    ends = listed(attributes, "ends", inputs, 2) or []
    axes = listed(attributes, "axes", inputs, 3) or list(range(len(starts)))
    steps = listed(attributes, "steps", inputs, 4) or [1] * len(starts)
    for start, end, axis, step in zip(starts, ends, axes, steps, strict=True):
        axis = axis_of(axis, value.rank)
        last = None if step < 0 and end < -shape[axis] else end
        taken = slice(start, last, step)
        if numbers is not None:
            numbers = numbers[(slice(None),) * axis + (taken,)]
        shape[axis] = len(range(shape[axis])[taken])
    return [made(tuple(shape), value) if numbers is None else known(numbers)]


def _gather(attributes: Attributes, inputs: Inputs) -> list[Value]:
    value, index = needed(inputs[0]), needed(inputs[1])
    if not value.rank:
        raise ValueError("a choice among a single number")
    axis = axis_of(int(attributes.get("axis", 0)), value.rank)
    _require_within(index, value.shape[axis])
    return [made((*value.shape[:axis], *index.shape, *value.shape[axis + 1 :]), value, _only_moving(value, index))]


def _gather_elements(attributes: Attributes, inputs: Inputs) -> list[Value]:
    value, index = needed(inputs[0]), needed(inputs[1])
    axis = axis_of(int(attributes.get("axis", 0)), value.rank)
    if value.rank != index.rank or not value.rank:
        raise ValueError("a choice among values of another number of axes")
    _require_within(index, value.shape[axis])
    return [made(index.shape, value, _only_moving(value, index))]


def _only_moving(value: Value, index: Value) -> Value:
    """What an index adds to what it chooses from: never its type."""
    return Value((), value.kind, index.moving)


def _require_within(index: Value, length: int) -> None:
    if index.kind == "f":
        raise ValueError("an index that is no whole number")
    if index.numbers is not None and index.size and not -length <= index.numbers.min() <= index.numbers.max() < length:
        raise IndexError("an index beyond the end")


def _expand(attributes: Attributes, inputs: Inputs) -> list[Value]:
    value, shape = needed(inputs[0]), listed(attributes, "shape", inputs, 1) or []
    if any(extent < 0 for extent in shape):
        raise ValueError("a shape with a number below zero")
    return [made(broadcast(value.shape, tuple(shape)), value)]


def _tile(attributes: Attributes, inputs: Inputs) -> list[Value]:
    value, repeats = needed(inputs[0]), listed(attributes, "repeats", inputs, 1) or []
    shape = (1,) * (len(repeats) - value.rank) + value.shape
    repeats = [1] * (len(shape) - len(repeats)) + repeats
    return [made(tuple(n * times for n, times in zip(shape, repeats, strict=True)), value)]


def _constant_of_shape(attributes: Attributes, inputs: Inputs) -> list[Value]:
    filling = inputs[1] if len(inputs) > 1 else known(0.0)
    if needed(filling).size != 1:
        raise ValueError("a filling of other than one number")
    return [made(tuple(listed(attributes, "shape", inputs, 0) or ()), filling)]


def _range(_: Attributes, inputs: Inputs) -> list[Value]:
    length = range_length(inputs)
    numbers = range_of(inputs)
    return [made((length,), inputs[0]) if numbers is None else known(numbers)]


_CONSTANTS = {"value_float": np.float32, "value_floats": np.float32, "value_int": np.int64, "value_ints": np.int64}
SHAPING_RULES: dict[str, Rule] = {
    "Constant": _constant,
    "ConstantOfShape": _constant_of_shape,
    "Shape": _shape,
    "Size": _size,
    "Reshape": _reshape,
    "Flatten": _flatten,
    "Squeeze": _squeeze,
    "Unsqueeze": _unsqueeze,
    "Transpose": _transpose,
    "Concat": _concat,
    "Split": _split,
    "Slice": _slice,
    "Gather": _gather,
    "GatherElements": _gather_elements,
    "Expand": _expand,
    "Tile": _tile,
    "Range": _range,
}
"""By operator."""
