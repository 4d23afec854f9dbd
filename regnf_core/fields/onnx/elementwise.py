"""ONNX's operators that work on each element by itself."""

from __future__ import annotations

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
