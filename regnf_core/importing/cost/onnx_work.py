"""How long a graph takes, and how much memory: told by one run, node by node, that ends as soon as it is too much."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress

import torch
from torch import Tensor

from regnf_core.errors import FieldFormatError
from regnf_core.fields.onnx.graph import OPERATOR_FUNCTIONS, Step, run_step
from regnf_core.importing.arrays import StoredArray
from regnf_core.importing.cost.mesh_work import GRADIENT, Calls
from regnf_core.schema.kinds import NodeDescription, OnnxDescription, last_uses
from regnf_core.schema.onnx_operators import SHAPE_ONLY

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
_TYPES = {"float32": torch.float32, "int64": torch.int64, "bool": torch.bool}
_ONCE = 10.0
"""What no point changes is computed here, in the import's checks, and again whenever the field is opened."""
_SLOPES = 2
"""With the gradient every value that depends on the points is kept, and a slope of the same size is made of it."""
_TEMPORARY = 2
"""An operator has so many arrays of its results' size while it runs, besides them."""


@torch.no_grad()
def onnx_needs(
    description: OnnxDescription,
    tensors: Mapping[str, StoredArray],
    calls: Calls,
    most_s: float = math.inf,
    most_bytes: float = math.inf,
) -> tuple[float, int]:
    """Seconds of one core that these calls take, by a conservative rate, and the most bytes that values take at once.

    Every shape is the same for all points (see Signature.settled), so one run tells them. Beyond ``most_s`` or
    ``most_bytes`` the run ends, and what is returned is what was counted so far.
    Raises FieldFormatError (ONNX_GRAPH_INVALID) where the graph contradicts itself, MemoryError.
    """
    values = _given(description, tensors)
    runs = float(sum(_runs(points, description.batch) for points in calls.values))
    runs += GRADIENT * sum(_runs(points, description.batch) for points in calls.gradients)
    last = last_uses(description.nodes, description.output)
    changing, kept = {description.input}, set[str]()
    alive = {name: _bytes(values[name]) for name in tensors}
    held = moving = most = sum(alive.values())
    seconds = 0.0
    for number, node in enumerate(description.nodes):
        given, moves = [values[name] for name in node.inputs], [name in changing for name in node.inputs]
        times = runs if any(moves) else _ONCE
        seconds += times * (_NODE_S + _products(node, given))
        if seconds > most_s:
            break
        step = Step(
            f"node {number} ({node.op})",
            OPERATOR_FUNCTIONS[node.op],
            {**node.attributes, "outputs": len(node.outputs)},
            node.inputs,
            node.outputs,
        )
        made = run_step(step, values)
        values |= made
        seconds += times * _elements_s(node, given, moves, list(made.values()))
        size = sum(map(_bytes, made.values()))
        if any(moves):
            moving += _SLOPES * size
            kept.update(node.inputs)
        else:
            alive |= {name: _bytes(value) for name, value in made.items()}
            held += size
        if any(moves) and node.op not in SHAPE_ONLY:
            changing.update(made)
        most = max(most, held + _TEMPORARY * size)
        held -= sum(alive.pop(name) for name in last[number] if name in alive and name not in kept)
        for name in last[number]:
            del values[name]
        if seconds > most_s or max(most, held + moving) > most_bytes:
            break
    return seconds, max(most, held + moving)


def _given(description: OnnxDescription, tensors: Mapping[str, StoredArray]) -> dict[str, Tensor | None]:
    """What is there before the first node: the points, the weights, the constants."""
    low, high = torch.tensor(description.function_bounds, dtype=torch.float32)
    points = low + (high - low) * torch.rand(description.batch, 3, generator=torch.Generator().manual_seed(0))
    values: dict[str, Tensor | None] = {"": None, description.input: points}
    for name, array in tensors.items():
        values[name] = torch.from_numpy(array).to(torch.float32 if array.dtype.kind == "f" else torch.int64)
    for name, constant in description.constants.items():
        if math.prod(constant.shape) != len(constant.values):
            message = f"the constant {name} has another size than its shape"
            raise FieldFormatError(message, reason="FIELD_SHAPES_MISMATCH")
        values[name] = torch.tensor(constant.values, dtype=_TYPES[constant.type]).reshape(constant.shape)
    return values


def _bytes(value: Tensor | None) -> int:
    return 0 if value is None else value.numel() * value.element_size()


def _runs(points: int, batch: int) -> int:
    """How often the graph runs for so many points: it is always given whole batches, of one chunk each."""
    chunk = max(batch, _CHUNK)
    whole, rest = divmod(points, chunk)
    return whole * -(-chunk // batch) + -(-rest // batch)


def _elements_s(
    node: NodeDescription, inputs: Sequence[Tensor | None], moves: Sequence[bool], results: Sequence[Tensor | None]
) -> float:
    """One run of one node. What goes in counts as well: it is read, and its slope has as many elements."""
    cheap = node.op in _CHEAP
    sizes = [
        each.numel() for each, moving in zip(inputs, moves, strict=True) if each is not None and (moving or not cheap)
    ]
    made = sum(0 if result is None else result.numel() for result in results)
    return (made * max(len(sizes), 1) + sum(sizes)) * (_CHEAP_S if cheap else _COSTLY_S)


def _products(node: NodeDescription, inputs: Sequence[Tensor | None]) -> float:
    """What multiplying matrices takes besides, before it is done."""
    a, b = ([*inputs, None, None])[:2]
    if node.op not in ("MatMul", "Gemm") or a is None or b is None or not a.dim() or not b.dim():
        return 0.0
    inner = a.shape[0] if node.op == "Gemm" and node.attributes.get("transA", 0) else a.shape[-1]
    with suppress(RuntimeError):  # shapes that do not fit one another: the run says so
        matrices = math.prod(torch.broadcast_shapes(a.shape[:-2], b.shape[:-2]))  # type: ignore[no-untyped-call]
        left, right = math.prod(a.shape[-2:]), math.prod(b.shape[-2:])
        rate = _PRODUCT_S if a.is_floating_point() or b.is_floating_point() else _WHOLE_PRODUCT_S
        copied = matrices * (left + right) if matrices > 1 else 0
        return matrices * (left * right / max(inner, 1) * rate + _MATRIX_S) + copied * _CHEAP_S
    return 0.0
