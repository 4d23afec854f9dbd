"""A network of any trainer as ONNX: (N, 3) points to N distances. Its graph becomes data of the kind ``onnx``."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import StoredArray
from regnf_core.importing.assumptions import INPUTS, UNSAID
from regnf_core.importing.families.converted import Assumed, ConvertedField
from regnf_core.importing.families.layers import (
    UNIT_CUBE,
    contradiction,
    refuse_other_entries,
    require_family,
    shared_entries,
)
from regnf_core.importing.onnx.model import Array, Attribute, Model, Node, Port, as_of_13, read_model, unsupported
from regnf_core.importing.upload_description import UploadDescription
from regnf_core.schema.kinds import MAX_BATCH, MAX_NUMBERS
from regnf_core.schema.onnx_operators import OPERATORS

_BATCH = 1024
_MIN_FIXED_BATCH = 64
_REAL_TYPES = (1, 10, 11)
_SMALL = 64
_MAX_TENSORS = 1_000
_INT32 = np.iinfo(np.int32)


def convert_onnx(data: memoryview, tensor_bytes: int, overrides: UploadDescription) -> ConvertedField:
    """The field of the ONNX model in ``data``.

    Raises FieldFormatError: ONNX_MALFORMED, ONNX_NOT_SUPPORTED, ONNX_EXTERNAL_DATA, TENSOR_DTYPE, TENSOR_NOT_FINITE,
    TENSOR_TOO_LARGE, and what ``overrides`` is refused for.
    """
    require_family(overrides, "onnx")
    refuse_other_entries(overrides, "onnx", ("output_column",))
    read = read_model(data)
    column = _column(read.output, overrides)
    model = as_of_13(read)
    batch, told = _batch(model.input, model.output, column is not None)
    parts = _Parts(model, tensor_bytes)
    output = parts.names[model.output.name] if column is None else parts.add_choice(model.output.name, column)
    description = {
        "kind": "onnx",
        "source": {"family": "onnx"},
        **shared_entries(overrides, UNIT_CUBE),
        "nodes": parts.nodes,
        "constants": parts.constants,
        "input": parts.names[model.input.name],
        "output": output,
        "batch": batch,
        "opset": model.opset,
    }
    why = (f"an ONNX model: {len(read.nodes)} nodes, operator set {read.opset}", told)
    warnings = (
        ()
        if overrides.bounds
        else ("BOUNDS_ASSUMED: [-1, 1]^3; if the field's region is another, give the import option bounds",)
    )
    assumes = (*UNSAID, INPUTS)
    converted = ConvertedField("onnx", why, description, parts.tensors, warnings, sign_is_open=True, assumes=assumes)
    if column is None or overrides.output_column is not None:
        return converted
    return replace(converted, assumed=Assumed({"output_column": column}))


def _column(made: Port, overrides: UploadDescription) -> int | None:
    """Which column of the output is the distance; None where the output is nothing but distances.

    Where nothing says it the first is, as in all known trainers' networks, if it behaves so.
    """
    wide = made.shape is not None and len(made.shape) == 2 and made.shape[1] not in (None, 1)
    said = overrides.output_column
    if wide and made.shape is not None and said is not None and said >= (made.shape[1] or 0):
        raise contradiction("output_column", said, f"{made.shape[1]} columns, counted from 0")
    if not wide and made.shape is not None and len(made.shape) == 1 and said is not None:
        raise contradiction("output_column", said, "one distance for each point")
    return said if said is not None else 0 if wide else None


def _batch(given: Port, made: Port, wide: bool = False) -> tuple[int, str]:
    """How many points to evaluate at once, and why. wide: whether the output may have several columns."""
    results: tuple[tuple[int | None, ...], ...] = ((None, None),) if wide else ((None,), (None, 1))
    for port, shapes in ((given, ((None, 3),)), (made, results)):
        if port.element_type not in _REAL_TYPES:
            raise unsupported(f"{port.name[:40]} does not hold real numbers")
        if port.shape is not None and not any(_fits(port.shape, shape) for shape in shapes):
            raise unsupported(f"the model maps {_shown(given)} to {_shown(made)}: (N, 3) to (N,) or (N, 1) is required")
    fixed = given.shape[0] if given.shape is not None else None
    if fixed is None:
        return _BATCH, f"any number of points; evaluated {_BATCH} at a time"
    if _MIN_FIXED_BATCH <= fixed <= MAX_BATCH:
        return fixed, f"exactly {fixed} points at a time"
    return _BATCH, f"made for {fixed} points, evaluated for {_BATCH} at a time: export with a dynamic number of points"


def _fits(shape: tuple[int | None, ...], overrides: tuple[int | None, ...]) -> bool:
    return len(shape) == len(overrides) and all(
        have is None or want is None or have == want for have, want in zip(shape, overrides, strict=True)
    )


def _shown(port: Port) -> str:
    return f"({', '.join('N' if extent is None else str(extent) for extent in port.shape or ())})"


class _Parts:
    """A model's nodes, constants and weights under names of our own, as the safe format has them."""

    def __init__(self, model: Model, tensor_bytes: int) -> None:
        self.names: dict[str, str] = {"": ""}
        self.constants: dict[str, Any] = {}
        self.tensors: dict[str, StoredArray] = {}
        self.nodes: list[dict[str, Any]] = []
        self._budget = tensor_bytes
        self._numbers = 0
        self._add_name(model.input.name)
        for name, values in model.weights.items():
            self._keep(name, values)
        for number, node in enumerate(model.nodes):
            self._add_node(number, node)
        if model.output.name not in self.names:
            raise unsupported("no node makes the model's output")

    def add_choice(self, name: str, column: int) -> str:
        """One more node that keeps one column of a value; the name of what it gives."""
        index, chosen = "the column", "of the column"
        self._keep(index, np.array([column], dtype=np.int64))
        self._add_node(-1, Node("Gather", (name, index), (chosen,), {"axis": 1}))
        return self.names[chosen]

    def _add_name(self, name: str) -> str:
        if name in self.names:
            raise unsupported("a value of the model is made twice, or has no name")
        self.names[name] = f"v{len(self.names)}"
        return self.names[name]

    def _add_node(self, number: int, node: Node) -> None:
        if node.op not in OPERATORS:
            raise unsupported(f"the operator {node.op} is not supported; docs/families.md lists the supported ones")
        attributes = dict(node.attributes)
        value = attributes.pop("value", None) if node.op in ("Constant", "ConstantOfShape") else None
        inputs = list(node.inputs)
        if isinstance(value, np.ndarray):
            if node.op == "Constant":
                self._keep(node.outputs[0] if node.outputs else "", value)
                return
            inputs.append(f"value of node {number}")
            self._keep(inputs[-1], value)
        unknown = [name for name in inputs if name not in self.names]
        if unknown:
            raise unsupported(f"node {number} ({node.op}) needs {unknown[0][:40]}, which no earlier node makes")
        outputs = list(node.outputs)
        while outputs and outputs[-1] == "":
            outputs.pop()
        self.nodes.append(
            {
                "op": node.op,
                "inputs": [self.names[name] for name in inputs],
                "outputs": [self._add_name(name) for name in outputs],
                "attributes": {name: _plain(node.op, name, given) for name, given in attributes.items()},
            }
        )

    def _keep(self, name: str, values: Array) -> None:
        """A small array as a constant of the description, a large one as a tensor."""
        ours = self._add_name(name)
        self._budget -= 4 * values.size
        if self._budget < 0:
            raise FieldFormatError("the model's weights exceed the limit", reason="TENSOR_TOO_LARGE")
        if values.dtype.kind == "f" and values.size > 1 and len(self.tensors) < _MAX_TENSORS:
            self.tensors[ours] = values
            return
        if values.dtype.kind == "i" and values.size > _SMALL and _fits_32_bits(values):
            self.tensors[ours] = values.astype(np.int32)
            return
        self._numbers += values.size
        if self._numbers > MAX_NUMBERS:
            raise unsupported("the model has too many whole numbers that exceed 32 bits")
        kind = {"f": "float32", "i": "int64", "b": "bool"}[values.dtype.kind]
        self.constants[ours] = {"type": kind, "shape": list(values.shape), "values": values.reshape(-1).tolist()}


def _fits_32_bits(values: Array) -> bool:
    return bool(_INT32.min <= values.min() and values.max() <= _INT32.max)


def _plain(op: str, name: str, value: Attribute) -> Any:
    if isinstance(value, np.ndarray) or (isinstance(value, list) and len(value) > _SMALL):
        raise unsupported(f"the operator {op} with the attribute {name} with too many numbers")
    numbers = [] if isinstance(value, str) else value if isinstance(value, list) else [value]
    if not all(math.isfinite(number) for number in numbers):
        raise unsupported(f"the operator {op} with the attribute {name} that is not a finite number")
    return value
