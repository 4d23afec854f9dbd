"""ONNX's operators that add elements up: products of matrices, normalizations, reductions, samples of a grid."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional

from regnf_core.fields.onnx.elementwise import Attributes, Operator, binary, needed, together
from regnf_core.fields.onnx.shaping import Inputs, numbers


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
