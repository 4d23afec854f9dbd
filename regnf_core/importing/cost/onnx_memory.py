"""How much memory a graph takes while it runs: the values that are alive at one time, from their shapes."""

from __future__ import annotations

from collections.abc import Mapping

from regnf_core.importing.arrays import StoredArray
from regnf_core.importing.cost.onnx_values import Kind, Value
from regnf_core.importing.cost.onnx_work import walk
from regnf_core.schema.kinds.onnx import OnnxDescription, last_uses

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
