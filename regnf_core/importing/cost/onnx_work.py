"""How long a graph takes: every operator's cost from the shapes of what goes in and comes out."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import StoredArray
from regnf_core.importing.cost.mesh_work import GRADIENT, Calls
from regnf_core.importing.cost.onnx_numbers import (
    Attributes,
    Inputs,
    Kind,
    Rule,
    Value,
    axis_of,
    broadcast,
    computed,
    known,
    listed,
    made,
    needed,
)
from regnf_core.importing.cost.onnx_shaping import SHAPING_RULES
from regnf_core.schema.kinds import NodeDescription, OnnxDescription, last_uses

# The shape of every operator's results, from the shapes of what goes in: ONNX's rules, nothing is evaluated.
#
# One function an operator or a group of them, listed in ``RULES``: an operator without a rule is refused. Each raises
# ValueError, IndexError, KeyError or TypeError where the graph contradicts itself.


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


_FAULTS = (ArithmeticError, IndexError, KeyError, TypeError, ValueError)
_CHUNK = 1 << 12
_CHEAP_S, _COSTLY_S, _NODE_S = 2e-9, 1.5e-8, 1.5e-5
"""Seconds: an element that is moved or added, one of any other function, the start of an operator."""
_PRODUCT_S, _WHOLE_PRODUCT_S, _MATRIX_S = 1e-10, 3e-9, 5e-8
"""Seconds: a multiplication and addition in a product of matrices, one of whole numbers, the start of a matrix."""
_CHEAP_NAMES = (
    "Abs Add And Cast Ceil Clip Concat ConstantOfShape Dropout Equal Expand Flatten Floor Gemm Greater GreaterOrEqual "
    "Identity LeakyRelu Less LessOrEqual MatMul Max Mean Min Mul Neg Not Or PRelu Range Relu Reshape Round Sign Slice "
    "Split Squeeze Sub Sum Tile Transpose Unsqueeze Where Xor"
)
_CHEAP = frozenset(_CHEAP_NAMES.split())
_TYPES = {"float32": np.float32, "int64": np.int64, "bool": np.bool_}


def onnx_work(description: OnnxDescription, tensors: Mapping[str, StoredArray], calls: Calls) -> float:
    """Seconds that the field's evaluation takes on one core, by a conservative rate.

    Raises FieldFormatError (ONNX_GRAPH_INVALID) where the graph contradicts itself, or the size of a value is beyond
    the limit or cannot be told.
    """
    once = each = 0.0
    for node, inputs, results in walk(description, tensors):
        seconds = _seconds(node, inputs, results)
        if any(value is not None and value.moving for value in inputs):
            each += seconds
        else:
            once += seconds
    runs = sum(_runs(points, description.batch) for points in calls.values)
    slopes = sum(_runs(points, description.batch) for points in calls.gradients)
    return once + (runs + GRADIENT * slopes) * each


def walk(
    description: OnnxDescription, tensors: Mapping[str, StoredArray]
) -> Iterator[tuple[NodeDescription, Inputs, list[Value]]]:
    """Every node in its turn, with what is known of its inputs and results. Raises as :func:`onnx_work` does."""
    values = _given(description, tensors)
    for number, node in enumerate(description.nodes):
        inputs = [values[name] for name in node.inputs]
        try:
            results = _results(node, inputs)
        except _FAULTS as error:
            message = f"node {number} ({node.op}): {str(error)[:200]}"
            raise FieldFormatError(message, reason="ONNX_GRAPH_INVALID") from error
        values |= dict(zip(node.outputs, results, strict=False))
        yield node, inputs, results


def _given(description: OnnxDescription, tensors: Mapping[str, StoredArray]) -> dict[str, Value | None]:
    """What is there before the first node: the points, the weights, the constants."""
    values: dict[str, Value | None] = {"": None, description.input: Value((description.batch, 3), moving=True)}
    values |= {name: known(array) for name, array in tensors.items()}
    for name, constant in description.constants.items():
        if math.prod(constant.shape) != len(constant.values):
            message = f"the constant {name} has another size than its shape"
            raise FieldFormatError(message, reason="FIELD_SHAPES_MISMATCH")
        values[name] = known(np.array(constant.values, dtype=_TYPES[constant.type]).reshape(constant.shape))
    return values


def _results(node: NodeDescription, inputs: Inputs) -> list[Value]:
    results = RULES[node.op]({**node.attributes, "outputs": len(node.outputs)}, inputs)
    if len(results) < len(node.outputs):
        raise ValueError("fewer outputs than named")
    return [computed(node.op, dict(node.attributes), inputs, result) for result in results]


def _runs(points: int, batch: int) -> int:
    """How often the graph runs for so many points: it is always given whole batches, of one chunk each."""
    chunk = max(batch, _CHUNK)
    whole, rest = divmod(points, chunk)
    return whole * -(-chunk // batch) + -(-rest // batch)


def _seconds(node: NodeDescription, inputs: Inputs, results: list[Value]) -> float:
    """One run of one node. What goes in counts as well: it is read, and its slope has as many elements."""
    sizes = [value.size for value in inputs if value is not None and (value.moving or node.op not in _CHEAP)]
    elements = sum(result.size for result in results) * max(len(sizes), 1) + sum(sizes)
    each = _CHEAP_S if node.op in _CHEAP else _COSTLY_S
    return _NODE_S + elements * each + _products(node, inputs, results[0])


def _products(node: NodeDescription, inputs: Inputs, result: Value) -> float:
    if node.op not in ("MatMul", "Gemm"):
        return 0.0
    a, b = needed(inputs[0]), needed(inputs[1])
    inner = a.shape[0] if node.op == "Gemm" and node.attributes.get("transA", 0) else a.shape[-1]
    rate = _PRODUCT_S if "f" in (a.kind, b.kind) else _WHOLE_PRODUCT_S
    matrices: int = math.prod(result.shape[:-2])
    copied: int = matrices * (math.prod(a.shape[-2:]) + math.prod(b.shape[-2:])) if matrices > 1 else 0
    return result.size * inner * rate + matrices * _MATRIX_S + copied * _CHEAP_S


# How much memory a graph takes while it runs: the values that are alive at one time, from their shapes.

_BYTES: dict[Kind, int] = {"b": 1, "i": 8, "f": 4}
_SLOPES = 2
"""With the gradient every value that depends on the points is kept, and a slope of the same size is made of it."""
_TEMPORARY = 2
"""An operator has so many arrays of its results' size while it runs, besides them."""


def onnx_bytes(description: OnnxDescription, tensors: Mapping[str, StoredArray]) -> int:
    """The most bytes that the graph's values take at once, its weights included. Raises as ``onnx_work`` does."""
    last = last_uses(description.nodes, description.output)
    alive: dict[str, int] = {
        name: _BYTES["f" if array.dtype.kind == "f" else "i"] * array.size for name, array in tensors.items()
    }
    held = sum(alive.values())
    moving = most = held
    kept: set[str] = set()
    for number, (node, inputs, results) in enumerate(walk(description, tensors)):
        size = sum(map(_size, results))
        if any(value is not None and value.moving for value in inputs):
            moving += _SLOPES * size
            kept.update(node.inputs)
        else:
            alive |= {name: _size(result) for name, result in zip(node.outputs, results, strict=False)}
            held += sum(alive[name] for name in node.outputs if name in alive)
        most = max(most, held + _TEMPORARY * size)
        held -= sum(alive.pop(name) for name in last[number] if name in alive and name not in kept)
    return max(most, held + moving)


def _size(value: Value) -> int:
    return value.size * _BYTES[value.kind]
