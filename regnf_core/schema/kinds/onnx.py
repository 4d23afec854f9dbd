"""The kind ``onnx``: any network, as a graph of ONNX's operators. The graph is data: names from a list, no code."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

from annotated_types import Ge, Le, Len, MaxLen

from regnf_core.schema.description import FORBID_UNKNOWN, FieldDescription
from regnf_core.schema.onnx_operators import OPERATORS, SHAPE_ONLY
from regnf_core.schema.tensor_check import TensorSpec, require, require_names

MAX_NODES = 2_000
MAX_NUMBERS = 20_000
"""Numbers that all constants together may hold; larger arrays are tensors."""
MAX_BATCH = 1 << 16

_Name = Annotated[str, MaxLen(32)]
_Names = Annotated[tuple[_Name, ...], MaxLen(64)]
_Number = int | float
AttributeValue = int | float | Annotated[str, MaxLen(64)] | Annotated[tuple[_Number, ...], MaxLen(64)]


@dataclass(frozen=True)
class NodeDescription:
    """One operation: its operator, the names of what goes in ("" if left out) and comes out, its settings."""

    __pydantic_config__: ClassVar[dict[str, Any]] = FORBID_UNKNOWN

    op: Annotated[str, MaxLen(40)]
    inputs: _Names
    outputs: _Names
    attributes: Annotated[dict[Annotated[str, MaxLen(40)], AttributeValue], MaxLen(64)]


@dataclass(frozen=True)
class ConstantDescription:
    """A small array: row after row, last axis fastest."""

    __pydantic_config__: ClassVar[dict[str, Any]] = FORBID_UNKNOWN

    type: Literal["float32", "int64", "bool"]
    shape: Annotated[tuple[Annotated[int, Ge(0), Le(MAX_NUMBERS)], ...], MaxLen(8)]
    values: Annotated[tuple[_Number, ...], MaxLen(MAX_NUMBERS)]


@dataclass(frozen=True, kw_only=True)
class OnnxDescription(FieldDescription):
    """A field of the onnx kind; see :class:`regnf_core.fields.onnx.graph.OnnxFunction`."""

    kind: Literal["onnx"]
    nodes: Annotated[tuple[NodeDescription, ...], Len(1, MAX_NODES)]
    """In the order of evaluation."""
    constants: Annotated[dict[_Name, ConstantDescription], MaxLen(MAX_NODES)]
    input: _Name
    output: _Name
    batch: Annotated[int, Ge(1), Le(MAX_BATCH)]
    """How many points the graph is always given at once; fewer are filled up."""
    opset: Annotated[int, Ge(13), Le(26)]

    def check_tensors(self, tensors: Mapping[str, TensorSpec]) -> None:
        """Raise FieldFormatError (FIELD_SHAPES_MISMATCH), naming the first node or tensor that is not as described."""
        require_names(tensors, set(tensors), integers={name for name, spec in tensors.items() if spec.dtype == "I32"})
        numbers = sum(len(constant.values) for constant in self.constants.values())
        require(numbers <= MAX_NUMBERS, f"the constants hold {numbers} numbers, at most {MAX_NUMBERS} are taken")
        given = [self.input, *tensors, *self.constants]
        require(len(set(given)) == len(given), "two things of one name")
        self._check_graph(dict.fromkeys(given, False) | {self.input: True})

    def _check_graph(self, by_points: dict[str, bool]) -> None:
        """``by_points``: the names known so far, and whether their values depend on the points."""
        for number, node in enumerate(self.nodes):
            where = f"node {number} ({node.op[:40]})"
            signature = OPERATORS.get(node.op)
            if signature is None:
                require(False, f"{where}: no operator that is taken")
                continue
            require(signature.least <= len(node.inputs) <= signature.most, f"{where}: {len(node.inputs)} inputs")
            require(1 <= len(node.outputs) <= signature.outputs, f"{where}: {len(node.outputs)} outputs")
            require(
                all(name == "" or name in by_points for name in node.inputs), f"{where}: an input that no node computes"
            )
            require(all(name and name not in by_points for name in node.outputs), f"{where}: an output made twice")
            moving = [by_points.get(name, False) for name in node.inputs]
            settled = not any(moving[i] for i in signature.settled if i < len(moving))
            require(settled, f"{where}: its shape would depend on the points")
            by_points |= dict.fromkeys(node.outputs, any(moving) and node.op not in SHAPE_ONLY)
        require(by_points.get(self.output, False), "the output does not depend on the points")


def last_uses(nodes: Sequence[NodeDescription], output: str) -> list[tuple[str, ...]]:
    """For each node the names that nothing after it reads; ``output`` is read in the end."""
    read = {"", output}
    found = []
    for node in reversed(nodes):
        found.append(tuple(dict.fromkeys(name for name in (*node.inputs, *node.outputs) if name not in read)))
        read.update(found[-1])
    return found[::-1]
