"""Small ONNX models for tests, made with ONNX's own library."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

Initializers = dict[str, np.ndarray[Any, Any]]
N = "n"


def nodes(text: str) -> list[onnx.NodeProto]:
    """Nodes, one a line or between semicolons: ``outputs = Operator inputs``, "-" for an input that is left out,
    attributes as ``name:json``.
    """
    return [_node(line) for line in text.replace(";", "\n").splitlines() if line.strip()]


def _node(line: str) -> onnx.NodeProto:
    outputs, _, rest = line.partition("=")
    op, *words = rest.split()
    inputs = [word.replace("-", "") for word in words if ":" not in word]
    attributes = {name: json.loads(value) for name, _, value in (word.partition(":") for word in words if ":" in word)}
    return helper.make_node(op, inputs, outputs.split(), **attributes)


def model(
    body: str | Sequence[onnx.NodeProto],
    initializers: Initializers | None = None,
    given: Sequence[int | str] | None = (N, 3),
    made: Sequence[int | str] | None = (N, 1),
    opset: int = 20,
    kind: int = TensorProto.FLOAT,
) -> onnx.ModelProto:
    """A model from ``x`` to ``y``."""
    graph = helper.make_graph(
        nodes(body) if isinstance(body, str) else list(body),
        "field",
        [helper.make_tensor_value_info("x", kind, given)],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, made)],
        [numpy_helper.from_array(values, name) for name, values in (initializers or {}).items()],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=10)


def sphere(**changes: Any) -> onnx.ModelProto:
    """|x| - 1/2."""
    axes, half = np.array([1]), np.array(0.5, np.float32)
    return model("r = ReduceL2 x axes keepdims:1; y = Sub r half", {"axes": axes, "half": half}, **changes)
