"""Nodes of ONNX's operator sets 9 to 12 as those of 13 have them, where the two differ in more than spelling.

Axes, shapes and places that older operators keep in attributes need no change: they are read from either place.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from regnf_core.importing.onnx.model import Model, Node
from regnf_core.importing.onnx.tensor import Array

OLDEST, PLAIN = 9, 13
"""The oldest set that is taken, and the one whose meaning the evaluator knows."""


def as_of_13(model: Model) -> Model:
    """The same function in operators of set 13 or later."""
    if model.opset >= PLAIN:
        return model
    weights = dict(model.weights)
    nodes = tuple(node for i, old in enumerate(model.nodes) for node in _rewritten(old, f"older {i} ", weights))
    return Model(PLAIN, nodes, weights, model.input, model.output)


def _rewritten(node: Node, own: str, weights: dict[str, Array]) -> Iterator[Node]:
    """own: how names begin that no other node uses."""
    limits = {name: node.attributes[name] for name in ("min", "max") if name in node.attributes}
    if node.op == "Clip" and limits:
        inputs = [node.inputs[0] if node.inputs else ""]
        for name in ("min", "max"):
            inputs.append(own + name if name in limits else "")
            if name in limits:
                weights[own + name] = np.array(limits[name], dtype=np.float32)
        yield Node("Clip", tuple(inputs), node.outputs, {})
    elif node.op in ("Softmax", "LogSoftmax") and len(node.inputs) == 1:
        flat, result, shape = (own + name for name in ("flat", "result", "shape"))
        yield Node("Flatten", node.inputs, (flat,), {"axis": node.attributes.get("axis", 1)})
        yield Node(node.op, (flat,), (result,), {"axis": -1})
        yield Node("Shape", node.inputs, (shape,), {})
        yield Node("Reshape", (result, shape), node.outputs, {})
    else:
        yield node
