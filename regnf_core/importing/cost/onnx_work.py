"""How long a graph takes: every operator's cost from the shapes of what goes in and comes out."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import StoredArray
from regnf_core.importing.cost.calls import GRADIENT, Calls
from regnf_core.importing.cost.onnx_numbers import computed
from regnf_core.importing.cost.onnx_shapes import RULES
from regnf_core.importing.cost.onnx_values import Inputs, Value, known, needed
from regnf_core.schema.kinds.onnx import NodeDescription, OnnxDescription

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
