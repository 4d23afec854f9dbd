"""ONNX's operators that move elements about, and those that say how many there are."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from regnf_core.fields.onnx.elementwise import Attributes, Operator, needed, require_few, together

Inputs = list[Tensor | None]


def numbers(attributes: Attributes, name: str, inputs: Inputs, position: int) -> list[int] | None:
    """Whole numbers given as an input, or, by older operator sets, as an attribute; None: left out."""
    if position < len(inputs) and (given := inputs[position]) is not None:
        return [int(value) for value in given.reshape(-1).tolist()]
    return [int(value) for value in attributes[name]] if name in attributes else None


def _constant(attributes: Attributes, _: Inputs) -> Tensor:
    if "value_float" in attributes:
        return torch.tensor(float(attributes["value_float"]))
    if "value_floats" in attributes:
        return torch.tensor([float(value) for value in attributes["value_floats"]])
    if "value_int" in attributes:
        return torch.tensor(int(attributes["value_int"]))
    return torch.tensor([int(value) for value in attributes["value_ints"]], dtype=torch.int64)


def _shape(attributes: Attributes, inputs: Inputs) -> Tensor:
    shape = list(needed(inputs[0]).shape)
    return torch.tensor(shape[attributes.get("start", 0) : attributes.get("end", len(shape))], dtype=torch.int64)


def _reshape(attributes: Attributes, inputs: Inputs) -> Tensor:
    value, shape = needed(inputs[0]), numbers(attributes, "shape", inputs, 1) or []
    if not attributes.get("allowzero", 0):
        shape = [value.shape[i] if extent == 0 else extent for i, extent in enumerate(shape)]
    return value.reshape(shape)


def _flatten(attributes: Attributes, inputs: Inputs) -> Tensor:
    value = needed(inputs[0])
    axis = int(attributes.get("axis", 1))
    axis = axis + value.dim() if axis < 0 else axis
    return value.reshape(math.prod(value.shape[:axis]), -1)


def _squeeze(attributes: Attributes, inputs: Inputs) -> Tensor:
    value, axes = needed(inputs[0]), numbers(attributes, "axes", inputs, 1)
    if axes is None:
        return value.squeeze()
    if any(value.shape[axis] != 1 for axis in axes):
        raise ValueError("a squeezed axis is longer than 1")
    return value.squeeze(tuple(axes))


def _unsqueeze(attributes: Attributes, inputs: Inputs) -> Tensor:
    value, axes = needed(inputs[0]), numbers(attributes, "axes", inputs, 1) or []
    rank = value.dim() + len(axes)
    for axis in sorted(axis % rank for axis in axes):
        value = value.unsqueeze(axis)
    return value


def _transpose(attributes: Attributes, inputs: Inputs) -> Tensor:
    value = needed(inputs[0])
    return value.permute(attributes.get("perm", tuple(reversed(range(value.dim())))))


def _concat(attributes: Attributes, inputs: Inputs) -> Tensor:
    return torch.cat(together(*inputs), dim=int(attributes["axis"]))


def _split(attributes: Attributes, inputs: Inputs) -> tuple[Tensor, ...]:
    value, axis = needed(inputs[0]), int(attributes.get("axis", 0))
    sizes = numbers(attributes, "split", inputs, 1)
    if sizes is None:
        parts = int(attributes["outputs"])
        sizes = [min(each, value.shape[axis] - start) for start, each in _even(value.shape[axis], parts)]
    return torch.split(value, sizes, dim=axis)


def _even(length: int, parts: int) -> list[tuple[int, int]]:
    each = -(-length // parts)
    return [(part * each, each) for part in range(parts)]


def _slice(attributes: Attributes, inputs: Inputs) -> Tensor:
    value = needed(inputs[0])
    starts = numbers(attributes, "starts", inputs, 1) or []
    ends = numbers(attributes, "ends", inputs, 2) or []
    axes = numbers(attributes, "axes", inputs, 3) or list(range(len(starts)))
    steps = numbers(attributes, "steps", inputs, 4) or [1] * len(starts)
    for start, end, axis, step in zip(starts, ends, axes, steps, strict=True):
        length = value.shape[axis]
        last = None if step < 0 and end < -length else end  # before the first one, going backwards
        order = torch.tensor(range(length)[slice(start, last, step)], dtype=torch.int64, device=value.device)
        value = value.index_select(axis, order)
    return value


def _gather(attributes: Attributes, inputs: Inputs) -> Tensor:
    axis = int(attributes.get("axis", 0))
    value, index = together(*inputs[:2])
    index = _within(index, value.shape[axis])
    axis = axis % value.dim()
    taken = value.index_select(axis, index.reshape(-1))
    return taken.reshape((*value.shape[:axis], *index.shape, *value.shape[axis + 1 :]))


def _gather_elements(attributes: Attributes, inputs: Inputs) -> Tensor:
    axis = int(attributes.get("axis", 0))
    value, index = together(*inputs[:2])
    return value.gather(axis, _within(index, value.shape[axis]))


def _within(index: Tensor, length: int) -> Tensor:
    """Indices from 0, negative ones counted from the end. Raises IndexError: an accelerator would only crash."""
    if index.numel() and not -length <= int(index.min()) <= int(index.max()) < length:
        raise IndexError("an index beyond the end")
    return torch.where(index < 0, index + length, index)


def _expand(attributes: Attributes, inputs: Inputs) -> Tensor:
    value, shape = needed(inputs[0]), numbers(attributes, "shape", inputs, 1) or []
    return value.expand(torch.broadcast_shapes(value.shape, shape))  # type: ignore[no-untyped-call]


def _tile(attributes: Attributes, inputs: Inputs) -> Tensor:
    value, repeats = needed(inputs[0]), numbers(attributes, "repeats", inputs, 1) or []
    require_few(value.numel() * math.prod(repeats))
    return value.tile(repeats)


def _constant_of_shape(attributes: Attributes, inputs: Inputs) -> Tensor:
    value = needed(inputs[1]) if len(inputs) > 1 else torch.zeros(1)
    return value.reshape(()).expand(numbers(attributes, "shape", inputs, 0) or [])


def _range(_: Attributes, inputs: Inputs) -> Tensor:
    start, limit, delta = together(*inputs)
    require_few((limit.item() - start.item()) / delta.item())
    return torch.arange(start.item(), limit.item(), delta.item(), dtype=start.dtype)


SHAPING: dict[str, Operator] = {
    "Constant": _constant,
    "ConstantOfShape": _constant_of_shape,
    "Shape": _shape,
    "Size": lambda attributes, inputs: torch.tensor(needed(inputs[0]).numel()),
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
