"""The graph of an ONNX model: nodes, weights, one input, one output. Whatever else a model may hold is refused."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from regnf_core.errors import FieldFormatError
from regnf_core.importing.onnx import wire

# Tensors of an ONNX model: only such whose numbers stand in the file itself.

_DIMS, _TYPE, _FLOATS, _INT32S, _INT64S, _NAME, _RAW, _DOUBLES, _EXTERNAL, _LOCATION = 1, 2, 4, 5, 7, 8, 9, 10, 13, 14
_RAW_TYPES = {1: "<f4", 2: "<u1", 3: "<i1", 6: "<i4", 7: "<i8", 9: "?", 10: "<f2", 11: "<f8"}
_FLOAT_FIELDS = {1: _FLOATS, 11: _DOUBLES}
_MAX_DIMENSIONS = 8
_MAX_ITEMS = 1 << 32
_LARGEST = np.finfo(np.float32).max

Array = npt.NDArray[Any]


def read_tensor(data: memoryview) -> tuple[str, Array]:
    """Name and values: float32, int64 or bool. Raises FieldFormatError: ONNX_MALFORMED, ONNX_EXTERNAL_DATA,
    TENSOR_DTYPE or TENSOR_NOT_FINITE.
    """
    message = wire.read_message(data)
    name, shape, kind = wire.text(message, _NAME), wire.integers(message, _DIMS), wire.integer(message, _TYPE)
    if message.get(_EXTERNAL) or wire.integer(message, _LOCATION) != 0:
        text = "the model has weights in another file: export it as one file (external_data=False)"
        raise FieldFormatError(text, reason="ONNX_EXTERNAL_DATA")
    # An axis of no length does not make the others harmless: numpy counts it as one.
    if len(shape) > _MAX_DIMENSIONS or any(n < 0 for n in shape) or math.prod(max(n, 1) for n in shape) > _MAX_ITEMS:
        raise wire.malformed("a tensor has an invalid shape")
    if kind not in _RAW_TYPES:
        raise FieldFormatError(f"an ONNX tensor of type {kind}; real numbers are required", reason="TENSOR_DTYPE")
    values = _values(message, kind)
    if values.size != math.prod(shape):
        raise wire.malformed(f"a tensor of {math.prod(shape)} numbers holds {values.size}")
    return name, _in_our_types(values.reshape(shape))


def _values(message: wire.Message, kind: int) -> Array:
    stored = np.dtype(_RAW_TYPES[kind])
    raw = wire.messages(message, _RAW)
    if raw:
        if len(raw[-1]) % stored.itemsize:
            raise wire.malformed("a tensor ends within a number")
        return np.frombuffer(raw[-1], dtype=stored)
    if kind in _FLOAT_FIELDS:
        whole = b"".join(bytes(value) for value in wire.messages(message, _FLOAT_FIELDS[kind]))
        return np.frombuffer(whole[: len(whole) // stored.itemsize * stored.itemsize], dtype=stored)
    numbers = np.array(wire.integers(message, _INT64S if kind == 7 else _INT32S), dtype=np.int64)
    return numbers.astype(np.uint16).view(np.float16) if stored.kind == "f" else numbers.astype(stored)


def _in_our_types(values: Array) -> Array:
    if values.dtype.kind == "b":
        return values
    if values.dtype.kind in "iu":
        return values.astype(np.int64)
    with np.errstate(over="ignore"):
        single = np.ascontiguousarray(values, dtype=np.float32)
    if np.isnan(single).any():
        raise FieldFormatError("an ONNX tensor holds NaN or an infinity", reason="TENSOR_NOT_FINITE")
    # an infinite bound of a clamp, or where a maximum starts: no safe file holds it
    return np.clip(single, -_LARGEST, _LARGEST)


MAX_NODES = 2_000
_MAX_TENSORS = 1_000
_MAX_NAMES = 64
_OPSETS = range(9, 27)

_OPSET_IMPORT, _GRAPH, _TRAINING, _FUNCTIONS = 8, 7, 20, 25
_NODES, _INITIALIZERS, _INPUTS, _OUTPUTS, _QUANTIZATION, _SPARSE = 1, 5, 11, 12, 14, 15
_NODE_IN, _NODE_OUT, _OP_TYPE, _ATTRIBUTES, _DOMAIN = 1, 2, 4, 5, 7
_ATTRIBUTE_NAME, _FLOAT, _INT, _STRING, _TENSOR, _FLOAT_LIST, _INT_LIST, _ATTRIBUTE_TYPE = 1, 2, 3, 4, 5, 7, 8, 20
_PLAIN_DOMAINS = ("", "ai.onnx")

Attribute = int | float | str | list[int] | list[float] | Array


@dataclass(frozen=True)
class Node:
    """One operation; inputs that are left out are ""."""

    op: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    attributes: dict[str, Attribute]


@dataclass(frozen=True)
class Port:
    """A graph's input or output; an extent that is left open is None, a shape that is left open too."""

    name: str
    element_type: int
    shape: tuple[int | None, ...] | None


@dataclass(frozen=True)
class Model:
    """A graph in the order of its evaluation."""

    opset: int
    nodes: tuple[Node, ...]
    weights: dict[str, Array]
    input: Port
    output: Port


def unsupported(message: str) -> FieldFormatError:
    """The error for a sound model that is more than a function of points."""
    return FieldFormatError(message, reason="ONNX_NOT_SUPPORTED")


def read_model(data: memoryview) -> Model:
    """The model in ``data``, the whole file.

    Raises FieldFormatError: ONNX_MALFORMED, ONNX_NOT_SUPPORTED, ONNX_EXTERNAL_DATA, TENSOR_DTYPE, TENSOR_NOT_FINITE.
    """
    message = wire.read_message(data)
    graphs = wire.messages(message, _GRAPH)
    if len(graphs) != 1:
        raise wire.malformed("not an ONNX model, or a model without a graph")
    if message.get(_TRAINING) or message.get(_FUNCTIONS):
        raise unsupported("the model has its own functions or training steps: export it with inlined functions")
    opset = _opset(message)
    graph = wire.read_message(graphs[0])
    if graph.get(_QUANTIZATION) or graph.get(_SPARSE):
        raise unsupported("the model is quantized or sparse")
    nodes = wire.messages(graph, _NODES)
    initializers = wire.messages(graph, _INITIALIZERS)
    if len(nodes) > MAX_NODES or len(initializers) > _MAX_TENSORS:
        raise unsupported(f"the model has {len(nodes)} nodes and {len(initializers)} weights")
    weights = dict(map(read_tensor, initializers))
    if len(weights) != len(initializers):
        raise wire.malformed("two weights have the same name")
    ports = [_port(data) for data in wire.messages(graph, _INPUTS)]
    inputs = [port for port in ports if port.name not in weights]  # old models list their weights among the inputs
    outputs = [_port(data) for data in wire.messages(graph, _OUTPUTS)]
    if len(inputs) != 1 or len(outputs) != 1:
        text = (
            f"the model has {len(inputs)} inputs and {len(outputs)} outputs: export only the mapping from points "
            f"to distances"
        )
        raise unsupported(text)
    return Model(opset, tuple(map(_node, nodes)), weights, inputs[0], outputs[0])


def _opset(message: wire.Message) -> int:
    versions = [wire.read_message(data) for data in wire.messages(message, _OPSET_IMPORT)]
    plain = [wire.integer(version, 2) for version in versions if wire.text(version, 1) in _PLAIN_DOMAINS]
    if len(plain) != 1 or plain[0] not in _OPSETS:
        raise unsupported(f"operator set {plain}: {_OPSETS.start} to {_OPSETS.stop - 1} are supported")
    return plain[0]


def _node(data: memoryview) -> Node:
    message = wire.read_message(data)
    op, domain = wire.text(message, _OP_TYPE), wire.text(message, _DOMAIN)
    if domain not in _PLAIN_DOMAINS:
        raise unsupported(f"the operator {op[:40]} of {domain[:40]} is not a standard ONNX operator")
    inputs = tuple(map(wire.decoded, wire.messages(message, _NODE_IN)))
    outputs = tuple(map(wire.decoded, wire.messages(message, _NODE_OUT)))
    attributes = wire.messages(message, _ATTRIBUTES)
    if max(len(inputs), len(outputs), len(attributes)) > _MAX_NAMES or not op.isalnum() or len(op) > 40:
        raise wire.malformed("a node has too many inputs or outputs")
    return Node(op, inputs, outputs, dict(_attribute(op, data) for data in attributes))


def _attribute(op: str, data: memoryview) -> tuple[str, Attribute]:
    message = wire.read_message(data)
    name = wire.text(message, _ATTRIBUTE_NAME)
    if len(name) > 40 or not name.isidentifier():
        raise wire.malformed("an attribute without a name")
    readers: dict[int, Any] = {
        1: lambda: wire.floats(message, _FLOAT)[-1],
        2: lambda: wire.integer(message, _INT),
        3: lambda: wire.text(message, _STRING),
        4: lambda: read_tensor(wire.messages(message, _TENSOR)[-1])[1],
        6: lambda: wire.floats(message, _FLOAT_LIST),
        7: lambda: wire.integers(message, _INT_LIST),
    }
    reader = readers.get(wire.integer(message, _ATTRIBUTE_TYPE))
    if reader is None:
        raise unsupported(f"the operator {op} with the attribute {name}: control flow and strings are not supported")
    try:
        value: Attribute = reader()
    except IndexError as error:
        raise wire.malformed(f"the attribute {name} is empty") from error
    return name, value


def _port(data: memoryview) -> Port:
    message = wire.read_message(data)
    name = wire.text(message, 1)
    types = [wire.read_message(part) for part in wire.messages(message, 2)]
    tensors = [wire.read_message(part) for type_ in types for part in wire.messages(type_, 1)]
    if len(tensors) != 1:
        raise unsupported(f"{name[:40]} is not a tensor")
    shapes = wire.messages(tensors[0], 2)
    shape = tuple(_extent(part) for part in wire.messages(wire.read_message(shapes[-1]), 1)) if shapes else None
    return Port(name, wire.integer(tensors[0], 1), shape)


def _extent(data: memoryview) -> int | None:
    message = wire.read_message(data)
    return wire.integer(message, 1) if 1 in message else None


# Nodes of ONNX's operator sets 9 to 12 as those of 13 have them, where the two differ in more than spelling.
#
# Axes, shapes and places that older operators keep in attributes need no change: they are read from either place.

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
