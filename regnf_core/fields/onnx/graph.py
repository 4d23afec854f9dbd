"""A graph of ONNX's operators as a function of points, with the gradient by automatic differentiation."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from regnf_core.errors import FieldFormatError
from regnf_core.fields.onnx.operators import (
    ELEMENTWISE,
    SHAPING,
    Attributes,
    Inputs,
    Operator,
    binary,
    needed,
    numbers,
    together,
)
from regnf_core.fields.user_fields import FunctionField
from regnf_core.schema.kinds import OnnxDescription, last_uses
from regnf_core.schema.onnx_operators import MAX_ELEMENTS

# ONNX's operators that add elements up: products of matrices, normalizations, reductions, samples of a grid.


def _gemm(attributes: Attributes, inputs: Inputs) -> Tensor:
    a, b = together(*inputs[:2])
    a = a.mT if attributes.get("transA", 0) else a
    b = b.mT if attributes.get("transB", 0) else b
    product = float(attributes.get("alpha", 1.0)) * (a @ b)
    if len(inputs) < 3 or inputs[2] is None:
        return product
    return product + float(attributes.get("beta", 1.0)) * inputs[2].to(product.device)


def _layer_normalization(attributes: Attributes, inputs: Inputs) -> Tensor:
    value, scale = together(*inputs[:2])
    axis = int(attributes.get("axis", -1)) % value.dim()
    bias = inputs[2].to(value.device) if len(inputs) > 2 and inputs[2] is not None else 0.0
    axes = tuple(range(axis, value.dim()))
    centered = value - value.mean(axes, keepdim=True)
    variance = centered.square().mean(axes, keepdim=True)
    return centered / (variance + float(attributes.get("epsilon", 1e-5))).sqrt() * scale + bias


def _batch_normalization(attributes: Attributes, inputs: Inputs) -> Tensor:
    if attributes.get("training_mode", 0):
        raise ValueError("a normalization in training")
    value, *rest = together(*inputs)
    shape = (1, -1, *([1] * (value.dim() - 2)))
    scale, bias, mean, variance = (part.reshape(shape) for part in rest)
    return (value - mean) / (variance + float(attributes.get("epsilon", 1e-5))).sqrt() * scale + bias


def _reduction(function: Callable[[Tensor, tuple[int, ...], bool], Tensor]) -> Operator:
    def run(attributes: Attributes, inputs: Inputs) -> Tensor:
        value, axes = needed(inputs[0]), numbers(attributes, "axes", inputs, 1)
        if not axes and attributes.get("noop_with_empty_axes", 0):
            return value
        chosen = tuple(axes) if axes else tuple(range(value.dim()))
        return function(value, chosen, bool(attributes.get("keepdims", 1)))

    return run


def _product(value: Tensor, axes: tuple[int, ...], keep: bool) -> Tensor:
    for axis in sorted((axis % value.dim() for axis in axes), reverse=True):
        value = value.prod(axis, keepdim=keep)
    return value


def _softmax(function: Callable[[Tensor, int], Tensor]) -> Operator:
    return lambda attributes, inputs: function(needed(inputs[0]), int(attributes.get("axis", -1)))


def _arg(function: Callable[..., Tensor]) -> Operator:
    def run(attributes: Attributes, inputs: Inputs) -> Tensor:
        if attributes.get("select_last_index", 0):
            raise ValueError("select_last_index")
        keep = bool(attributes.get("keepdims", 1))
        return function(needed(inputs[0]), dim=int(attributes.get("axis", 0)), keepdim=keep)

    return run


def _grid_sample(attributes: Attributes, inputs: Inputs) -> Tensor:
    value, grid = together(*inputs[:2])
    mode = {"linear": "bilinear", "bilinear": "bilinear", "nearest": "nearest"}[str(attributes.get("mode", "linear"))]
    return functional.grid_sample(
        value,
        grid,
        mode=mode,
        padding_mode=str(attributes.get("padding_mode", "zeros")),
        align_corners=bool(attributes.get("align_corners", 0)),
    )


LINEAR: dict[str, Operator] = {
    "MatMul": binary(torch.matmul),
    "Gemm": _gemm,
    "LayerNormalization": _layer_normalization,
    "BatchNormalization": _batch_normalization,
    "Softmax": _softmax(torch.softmax),
    "LogSoftmax": _softmax(torch.log_softmax),
    "ArgMax": _arg(torch.argmax),
    "ArgMin": _arg(torch.argmin),
    "GridSample": _grid_sample,
    "ReduceSum": _reduction(lambda x, axes, keep: x.sum(axes, keep)),
    "ReduceMean": _reduction(lambda x, axes, keep: x.mean(axes, keep)),
    "ReduceMax": _reduction(lambda x, axes, keep: x.amax(axes, keep)),
    "ReduceMin": _reduction(lambda x, axes, keep: x.amin(axes, keep)),
    "ReduceProd": _reduction(_product),
    "ReduceL1": _reduction(lambda x, axes, keep: x.abs().sum(axes, keep)),
    "ReduceL2": _reduction(lambda x, axes, keep: x.square().sum(axes, keep).sqrt()),
    "ReduceSumSquare": _reduction(lambda x, axes, keep: x.square().sum(axes, keep)),
    "ReduceLogSumExp": _reduction(lambda x, axes, keep: x.logsumexp(axes, keep)),
}


OPERATOR_FUNCTIONS: dict[str, Operator] = ELEMENTWISE | SHAPING | LINEAR
_TYPES = {"float32": torch.float32, "int64": torch.int64, "bool": torch.bool}
_FAULTS = (ArithmeticError, AssertionError, IndexError, KeyError, RuntimeError, TypeError, ValueError)
_NO_MEMORY = "allocate memory"


@dataclass(frozen=True)
class Step:
    """One operation of the graph, ready to run."""

    where: str
    function: Operator
    attributes: dict[str, Any]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    last: tuple[str, ...] = ()
    """What no later step reads: it is let go of."""


@dataclass(frozen=True)
class OnnxFunction:
    """Evaluates ``steps`` on batches of exactly ``batch`` points: so every value has one shape, that of the first run.

    ``known``: whatever does not depend on the points. Real numbers are float32 and whole ones int64 throughout,
    whatever the model says. Raises FieldFormatError (ONNX_GRAPH_INVALID) where the graph contradicts itself.
    """

    steps: tuple[Step, ...]
    known: dict[str, Tensor]
    input: str
    output: str
    batch: int

    @property
    def device(self) -> torch.device:
        floats = (value for value in self.known.values() if value.is_floating_point())
        return next(floats, torch.zeros(0)).device

    def to(self, device: torch.device | str) -> OnnxFunction:
        """The same function with its weights on another device; whole numbers that say shapes stay where they are."""
        moved = {
            name: value.to(device) if value.is_floating_point() or value.numel() > 64 else value
            for name, value in self.known.items()
        }
        return OnnxFunction(self.steps, moved, self.input, self.output, self.batch)

    def value(self, points: Tensor) -> Tensor:
        parts = [self._run(part)[: len(part)] for part in torch.split(points, self.batch) if len(part)]
        return torch.cat([points.new_zeros(0), *parts])

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        distances, gradients = [points.new_zeros(0)], [points.new_zeros(0, 3)]
        for part in torch.split(points, self.batch) if len(points) else ():
            with torch.enable_grad():
                leaf = part.detach().clone().requires_grad_()
                distance = self._run(leaf)[: len(part)]
                gradient = self._slope(distance, leaf)
            distances.append(distance.detach())
            gradients.append(gradient)
        return torch.cat(distances), torch.cat(gradients)

    @staticmethod
    def _slope(distance: Tensor, leaf: Tensor) -> Tensor:
        if not distance.requires_grad:  # constant, or made of steps alone
            return torch.zeros_like(leaf)
        try:
            (gradient,) = torch.autograd.grad(distance.sum(), leaf, allow_unused=True)
        except _FAULTS as error:
            raise _fault("the gradient", error) from error
        return torch.zeros_like(leaf) if gradient is None else gradient

    def _run(self, points: Tensor) -> Tensor:
        """Distances (batch,) of at most ``batch`` points; the missing ones are copies of the first."""
        missing = self.batch - len(points)
        filled = torch.cat((points, points[:1].detach().expand(missing, 3))) if missing else points
        values: dict[str, Tensor | None] = {**self.known, self.input: filled, "": None}
        for step in self.steps:
            values |= run_step(step, values)
            for name in step.last:
                del values[name]
        result = values[self.output]
        if result is None or result.shape not in ((self.batch,), (self.batch, 1)):
            shape = None if result is None else tuple(result.shape)
            message = f"for {self.batch} points the graph gives {shape}, not one distance each"
            raise FieldFormatError(message, reason="ONNX_GRAPH_INVALID")
        return result.reshape(self.batch).float()


def run_step(step: Step, values: Mapping[str, Tensor | None]) -> dict[str, Tensor | None]:
    """The outputs of one operation. Raises FieldFormatError (ONNX_GRAPH_INVALID), MemoryError."""
    try:
        found = step.function(step.attributes, [values[name] for name in step.inputs])
    except _FAULTS as error:
        raise _fault(step.where, error) from error
    outputs = found if isinstance(found, tuple) else (found,)
    if len(outputs) < len(step.outputs) or any(value.numel() > MAX_ELEMENTS for value in outputs):
        message = f"{step.where}: fewer outputs than named, or more than {MAX_ELEMENTS} numbers"
        raise FieldFormatError(message, reason="ONNX_GRAPH_INVALID")
    return dict(zip(step.outputs, outputs, strict=False))


def _fault(where: str, error: Exception) -> Exception:
    """What torch's error stands for: too little memory, or a graph that contradicts itself."""
    if _NO_MEMORY in str(error):
        return MemoryError(str(error))
    return FieldFormatError(f"{where}: {str(error)[:200]}", reason="ONNX_GRAPH_INVALID")


def build_onnx(description: OnnxDescription, tensors: Mapping[str, Tensor]) -> FunctionField[OnnxFunction]:
    """The field of ``description`` with its weights in ``tensors``. What no point changes is computed here, once."""
    known: dict[str, Tensor | None] = {
        name: tensor.float() if tensor.is_floating_point() else tensor.long() for name, tensor in tensors.items()
    }
    for name, constant in description.constants.items():
        if math.prod(constant.shape) != len(constant.values):
            raise FieldFormatError(
                f"the constant {name} has another size than its shape", reason="FIELD_SHAPES_MISMATCH"
            )
        known[name] = torch.tensor(constant.values, dtype=_TYPES[constant.type]).reshape(constant.shape)
    steps = []
    shapes_known = {**known, "": None}
    read_later: set[str] = set()
    last = last_uses(description.nodes, description.output)
    for number, node in enumerate(description.nodes):
        attributes = {**node.attributes, "outputs": len(node.outputs)}
        where = f"node {number} ({node.op})"
        step = Step(where, OPERATOR_FUNCTIONS[node.op], attributes, node.inputs, node.outputs, last[number])
        if all(name in shapes_known for name in node.inputs):
            shapes_known |= run_step(step, shapes_known)
        else:
            steps.append(step)
            read_later.update(node.inputs)
        for name in last[number]:
            if name not in read_later:
                shapes_known.pop(name, None)
    kept = read_later | {description.output}
    settled = {name: value for name, value in shapes_known.items() if name in kept and value is not None}
    function = OnnxFunction(tuple(steps), settled, description.input, description.output, description.batch)
    bounds = torch.tensor(description.function_bounds, dtype=torch.float64)
    return FunctionField(function, bounds, chunk=max(description.batch, 1 << 12))
