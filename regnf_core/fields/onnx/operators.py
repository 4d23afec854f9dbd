"""ONNX's operators that work on each element by itself."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from regnf_core.schema.onnx_operators import MAX_ELEMENTS

Attributes = dict[str, Any]
Operator = Callable[[Attributes, "list[Tensor | None]"], "Tensor | tuple[Tensor, ...]"]

_FLOAT_TYPES, _INT_TYPES, _BOOL_TYPE = (1, 10, 11, 16), (2, 3, 4, 5, 6, 7, 12, 13), 9
"""ONNX's numbers of types; here all real numbers are float32 and all whole ones int64."""


def needed(value: Tensor | None) -> Tensor:
    """An input that may not be left out. Raises ValueError."""
    if value is None:
        raise ValueError("an input is left out")
    return value


def require_few(elements: float) -> None:
    """Refuse a value before it is made. Raises ValueError."""
    if elements > MAX_ELEMENTS:
        raise ValueError(f"a value of more than {MAX_ELEMENTS} numbers")


def together(*values: Tensor | None) -> list[Tensor]:
    """All on one device: what follows from shapes alone is made on the CPU."""
    tensors = [needed(value) for value in values]
    device = next((t.device for t in tensors if t.device.type != "cpu"), tensors[0].device)
    return [t.to(device) for t in tensors]


def unary(function: Callable[[Tensor], Tensor]) -> Operator:
    """An operator of one input without settings."""
    return lambda attributes, inputs: function(needed(inputs[0]))


def binary(function: Callable[[Tensor, Tensor], Tensor]) -> Operator:
    """An operator of two inputs without settings."""
    return lambda attributes, inputs: function(*together(*inputs[:2]))


def variadic(function: Callable[[Tensor, Tensor], Tensor]) -> Operator:
    """An operator that folds any number of inputs."""

    def run(_: Attributes, inputs: list[Tensor | None]) -> Tensor:
        first, *rest = together(*inputs)
        for value in rest:
            first = function(first, value)
        return first

    return run


def _with_setting(name: str, default: float, function: Callable[[Tensor, float], Tensor]) -> Operator:
    return lambda attributes, inputs: function(needed(inputs[0]), float(attributes.get(name, default)))


def _cast(attributes: Attributes, inputs: list[Tensor | None]) -> Tensor:
    kind, value = attributes["to"], needed(inputs[0])
    if kind in _FLOAT_TYPES:
        return value.float()
    if kind in _INT_TYPES:
        return value.long()
    if kind == _BOOL_TYPE:
        return value.bool()
    raise ValueError(f"type {kind}")


def _clip(_: Attributes, inputs: list[Tensor | None]) -> Tensor:
    value = needed(inputs[0])
    low, high = ([*inputs, None, None])[1:3]
    if low is not None:
        value = torch.maximum(*together(value, low))
    return value if high is None else torch.minimum(*together(value, high))


def _div(a: Tensor, b: Tensor) -> Tensor:
    if a.is_floating_point():
        return a / b
    if b.is_floating_point():
        return torch.div(a, b, rounding_mode="trunc")
    # The processor traps where the lowest number is divided by -1; its opposite wraps as all whole numbers here do.
    opposite = b == -1
    quotient = torch.div(a, torch.where(opposite, 1, b), rounding_mode="trunc")
    return torch.where(opposite, -a, quotient)


def _mod(attributes: Attributes, inputs: list[Tensor | None]) -> Tensor:
    return (torch.fmod if attributes.get("fmod", 0) else torch.remainder)(*together(*inputs[:2]))


def _hard_sigmoid(attributes: Attributes, inputs: list[Tensor | None]) -> Tensor:
    alpha, beta = float(attributes.get("alpha", 0.2)), float(attributes.get("beta", 0.5))
    return (alpha * needed(inputs[0]) + beta).clamp(0.0, 1.0)


def _gelu(attributes: Attributes, inputs: list[Tensor | None]) -> Tensor:
    return functional.gelu(needed(inputs[0]), approximate=str(attributes.get("approximate", "none")))


def _selu(attributes: Attributes, inputs: list[Tensor | None]) -> Tensor:
    alpha, gamma = attributes.get("alpha", 1.6732632423543772), attributes.get("gamma", 1.0507009873554805)
    return float(gamma) * functional.elu(needed(inputs[0]), float(alpha))


def _where(_: Attributes, inputs: list[Tensor | None]) -> Tensor:
    condition, a, b = together(*inputs)
    return torch.where(condition, a, b)


def _mean(attributes: Attributes, inputs: list[Tensor | None]) -> Tensor:
    total = variadic(torch.add)(attributes, inputs)
    assert isinstance(total, Tensor)
    return total / len(inputs)


_ALSO_IN_TORCH = (
    *("Abs", "Acos", "Acosh", "Asin", "Asinh", "Atan", "Atanh", "Ceil", "Cos", "Cosh", "Erf", "Exp", "Floor", "Log"),
    *("Neg", "Reciprocal", "Round", "Sigmoid", "Sign", "Sin", "Sinh", "Sqrt", "Tan", "Tanh"),
)

ELEMENTWISE: dict[str, Operator] = {
    **{name: unary(getattr(torch, name.lower())) for name in _ALSO_IN_TORCH},
    "Identity": unary(lambda x: x),
    "Dropout": unary(lambda x: x),
    "Not": unary(torch.logical_not),
    "Relu": unary(torch.relu),
    "Softplus": unary(lambda x: torch.logaddexp(x, torch.zeros((), device=x.device))),
    "Softsign": unary(functional.softsign),
    "Mish": unary(functional.mish),
    "HardSwish": unary(lambda x: x * (x / 6.0 + 0.5).clamp(0.0, 1.0)),
    "Elu": _with_setting("alpha", 1.0, functional.elu),
    "Celu": _with_setting("alpha", 1.0, functional.celu),
    "LeakyRelu": _with_setting("alpha", 0.01, functional.leaky_relu),
    "ThresholdedRelu": _with_setting("alpha", 1.0, lambda x, alpha: torch.where(x > alpha, x, 0.0)),
    "Selu": _selu,
    "Gelu": _gelu,
    "HardSigmoid": _hard_sigmoid,
    "Cast": _cast,
    "Clip": _clip,
    "Add": binary(torch.add),
    "Sub": binary(torch.sub),
    "Mul": binary(torch.mul),
    "Div": binary(_div),
    "Mod": _mod,
    "Pow": binary(torch.pow),
    "PRelu": binary(lambda x, slope: torch.where(x < 0, slope * x, x)),
    "And": binary(torch.logical_and),
    "Or": binary(torch.logical_or),
    "Xor": binary(torch.logical_xor),
    "BitwiseAnd": binary(torch.bitwise_and),
    "BitwiseOr": binary(torch.bitwise_or),
    "BitwiseXor": binary(torch.bitwise_xor),
    "Equal": binary(torch.eq),
    "Greater": binary(torch.gt),
    "GreaterOrEqual": binary(torch.ge),
    "Less": binary(torch.lt),
    "LessOrEqual": binary(torch.le),
    "Max": variadic(torch.maximum),
    "Min": variadic(torch.minimum),
    "Sum": variadic(torch.add),
    "Mean": _mean,
    "Where": _where,
}


# ONNX's operators that move elements about, and those that say how many there are.

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
