"""The shape of every operator's results, from the shapes of what goes in: ONNX's rules, nothing is evaluated.

One function an operator or a group of them, listed in ``RULES``: an operator without a rule is refused. Each raises
ValueError, IndexError, KeyError or TypeError where the graph contradicts itself.
"""

from __future__ import annotations

from regnf_core.importing.cost.onnx_shaping import SHAPING_RULES
from regnf_core.importing.cost.onnx_values import (
    Attributes,
    Inputs,
    Kind,
    Rule,
    Value,
    axis_of,
    broadcast,
    listed,
    made,
    needed,
)


def _same(kind: Kind | None = None) -> Rule:
    """Each element by itself, all inputs of one shape."""

    def rule(_: Attributes, inputs: Inputs) -> list[Value]:
        given = [needed(value) for value in inputs]
        return [made(broadcast(*(value.shape for value in given)), *given, kind=kind)]

    return rule


def _arithmetic(attributes: Attributes, inputs: Inputs) -> list[Value]:
    """Without truth values, of which there is no difference and no opposite."""
    if all(needed(value).kind == "b" for value in inputs):
        raise ValueError("arithmetic with truth values")
    return _same()(attributes, inputs)


def _first(_: Attributes, inputs: Inputs) -> list[Value]:
    """The shape of the first input; the others are small, or settings."""
    return [made(needed(inputs[0]).shape, *inputs[:1], kind="f")]


def _cast(attributes: Attributes, inputs: Inputs) -> list[Value]:
    to = int(attributes["to"])
    kind: Kind = "b" if to == 9 else "f" if to in (1, 10, 11, 16) else "i"
    return [made(needed(inputs[0]).shape, inputs[0], kind=kind)]


def _clip(_: Attributes, inputs: Inputs) -> list[Value]:
    given = [value for value in inputs if value is not None]
    return [made(broadcast(*(value.shape for value in given)), needed(inputs[0]), *given)]


def _identity(_: Attributes, inputs: Inputs) -> list[Value]:
    return [made(needed(inputs[0]).shape, inputs[0])]


def _matmul(_: Attributes, inputs: Inputs) -> list[Value]:
    a, b = needed(inputs[0]), needed(inputs[1])
    if not a.rank or not b.rank:
        raise ValueError("a product of matrices with a single number")
    left, right = a.shape if a.rank > 1 else (1, *a.shape), b.shape if b.rank > 1 else (*b.shape, 1)
    if left[-1] != right[-2]:
        raise ValueError(f"a product of {a.shape} and {b.shape}")
    rows, columns = left[-2:-1] if a.rank > 1 else (), right[-1:] if b.rank > 1 else ()
    return [made((*broadcast(left[:-2], right[:-2]), *rows, *columns), a, b)]


def _gemm(attributes: Attributes, inputs: Inputs) -> list[Value]:
    a, b = (needed(value).shape for value in inputs[:2])
    if len(a) != 2 or len(b) != 2:
        raise ValueError("a product of what are no matrices")
    a, b = a[::-1] if attributes.get("transA", 0) else a, b[::-1] if attributes.get("transB", 0) else b
    if a[1] != b[0]:
        raise ValueError(f"a product of {a} and {b}")
    added = inputs[2].shape if len(inputs) > 2 and inputs[2] is not None else ()
    return [made(broadcast((a[0], b[1]), added), *inputs)]


def _batch_normalization(_: Attributes, inputs: Inputs) -> list[Value]:
    """The others lie along the second axis."""
    value, *rest = (needed(given) for given in inputs)
    along = [(1, other.size, *([1] * (value.rank - 2))) for other in rest]
    return [made(broadcast(value.shape, *along), *inputs, kind="f")]


def _layer_normalization(_: Attributes, inputs: Inputs) -> list[Value]:
    return [made(broadcast(*(value.shape for value in inputs if value is not None)), *inputs, kind="f")]


def _reduction(attributes: Attributes, inputs: Inputs) -> list[Value]:
    value, axes = needed(inputs[0]), listed(attributes, "axes", inputs, 1)
    if not axes and attributes.get("noop_with_empty_axes", 0):
        return [made(value.shape, value)]
    chosen = {axis_of(axis, value.rank) for axis in axes} if axes else set(range(value.rank))
    return [made(_without(value.shape, chosen, attributes), value)]


def _extreme(attributes: Attributes, inputs: Inputs) -> list[Value]:
    value = needed(inputs[0])
    return [
        made(_without(value.shape, {axis_of(int(attributes.get("axis", 0)), value.rank)}, attributes), value, kind="i")
    ]


def _without(shape: tuple[int, ...], axes: set[int], attributes: Attributes) -> tuple[int, ...]:
    keep = bool(attributes.get("keepdims", 1))
    return tuple(1 if axis in axes else n for axis, n in enumerate(shape) if keep or axis not in axes)


def _grid_sample(_: Attributes, inputs: Inputs) -> list[Value]:
    value, grid = needed(inputs[0]), needed(inputs[1])
    if value.rank not in (4, 5) or grid.rank != value.rank or grid.shape[-1] != value.rank - 2:
        raise ValueError("a grid of other than two or three axes")
    if value.shape[0] != grid.shape[0] or not all(value.shape):
        raise ValueError("a grid of another number of samples, or an empty one")
    return [made((*value.shape[:2], *grid.shape[1:-1]), value, grid, kind="f")]


def _where(_: Attributes, inputs: Inputs) -> list[Value]:
    condition, a, b = (needed(value) for value in inputs)
    # The condition adds nothing to the type of what it chooses between.
    return [made(broadcast(condition.shape, a.shape, b.shape), a, b, Value((), "b", condition.moving))]


_REAL = (
    "Acos Acosh Asin Asinh Atan Atanh Celu Cos Cosh Div Elu Erf Exp Gelu HardSigmoid HardSwish LeakyRelu Log Mish "
    "Reciprocal Selu Sigmoid Sin Sinh Softplus Softsign Sqrt Tan Tanh ThresholdedRelu"
)
_OF_ELEMENTS = "Add BitwiseAnd BitwiseOr BitwiseXor Max Mean Min Mod Mul PRelu Pow Sum"
_QUESTIONS = "And Equal Greater GreaterOrEqual Less LessOrEqual Not Or Xor"
RULES: dict[str, Rule] = {
    **dict.fromkeys(("Abs", "Ceil", "Dropout", "Floor", "Identity", "Relu", "Round", "Sign"), _identity),
    **dict.fromkeys(_REAL.split(), _same()),
    **dict.fromkeys(
        ["Add", "BitwiseAnd", "BitwiseOr", "BitwiseXor", "Max", "Mean", "Min", "Mod", "Mul", "PRelu", "Pow", "Sum"],
        _same(),
    ),
    **dict.fromkeys(
        ["And", "Equal", "Greater", "GreaterOrEqual", "Less", "LessOrEqual", "Not", "Or", "Xor"], _same("b")
    ),
    **dict.fromkeys(("ReduceL1", "ReduceL2", "ReduceLogSumExp", "ReduceMax", "ReduceMean"), _reduction),
    **dict.fromkeys(("ReduceMin", "ReduceProd", "ReduceSum", "ReduceSumSquare"), _reduction),
    **dict.fromkeys(("ArgMax", "ArgMin"), _extreme),
    **dict.fromkeys(("Softmax", "LogSoftmax"), _first),
    "Sub": _arithmetic,
    "Neg": _arithmetic,
    "Where": _where,
    "Cast": _cast,
    "Clip": _clip,
    "MatMul": _matmul,
    "Gemm": _gemm,
    "BatchNormalization": _batch_normalization,
    "LayerNormalization": _layer_normalization,
    "GridSample": _grid_sample,
} | SHAPING_RULES
"""By operator."""
