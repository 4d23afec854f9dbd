"""Graphs of ONNX's operators: each operator against onnxruntime, gradients against finite differences."""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from regnf_core.errors import FieldFormatError
from regnf_core.fields.build import build_field
from regnf_core.fields.observation import SdfField
from regnf_core.fields.onnx.graph import OPERATOR_FUNCTIONS
from regnf_core.importing.families.onnx import convert_onnx
from regnf_core.importing.upload_description import UploadDescription
from regnf_core.schema.onnx_operators import MAX_ELEMENTS, OPERATORS, SHAPE_ONLY
from regnf_core.schema.safe_format import description_to_dict, parse_description
from tests.core.importing.onnx_models import Initializers, model, nodes, sphere

RNG = np.random.default_rng(0)
W = RNG.normal(size=(3, 5)).astype(np.float32)
ROW = RNG.normal(size=5).astype(np.float32)
GRID = RNG.normal(size=(1, 2, 4, 5, 6)).astype(np.float32)
AXES = np.array([1])


def ints(*values: int) -> np.ndarray[Any, Any]:
    return np.array(values, np.int64)


def points(count: int = 700) -> torch.Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1


def field_of(proto: onnx.ModelProto) -> SdfField:
    found = convert_onnx(memoryview(proto.SerializeToString()), 1 << 24, UploadDescription())
    description = parse_description(description_to_dict(parse_description(found.description)))
    return build_field(description, {name: torch.from_numpy(array) for name, array in found.tensors.items()})


def runtime(proto: onnx.ModelProto, at: torch.Tensor) -> torch.Tensor:
    session = onnxruntime.InferenceSession(proto.SerializeToString(), providers=["CPUExecutionProvider"])
    return torch.from_numpy(session.run(None, {"x": at.numpy()})[0].reshape(-1))


def assert_agrees(proto: onnx.ModelProto) -> None:
    at = points()
    torch.testing.assert_close(field_of(proto).signed_distance(at), runtime(proto, at), rtol=2e-5, atol=2e-6)


ONE_BY_ONE = """
Abs Acos Asin Asinh Atan Atanh Ceil Celu Cos Cosh Dropout Elu Erf Exp Floor Gelu HardSigmoid HardSwish Identity
LeakyRelu LogSoftmax Mish Neg Relu Round Selu Sigmoid Sign Sin Sinh Softmax Softplus Softsign Tan Tanh ThresholdedRelu
"""
WITH_SETTINGS = (
    *("Elu x alpha:0.3", "LeakyRelu x alpha:0.3", "Celu x alpha:0.7", "ThresholdedRelu x alpha:0.2"),
    *("HardSigmoid x alpha:0.5 beta:0.1", 'Gelu x approximate:"tanh"', "Selu x alpha:1.5 gamma:0.9"),
    "Softmax x axis:1",
)


@pytest.mark.parametrize("text", [*(f"{op} x" for op in ONE_BY_ONE.split()), *WITH_SETTINGS])
def test_operators_of_one_input(text: str) -> None:
    assert_agrees(model(f"h = {text}; y = MatMul h w", {"w": W[:, :1]}))


def scalar(value: float) -> np.ndarray[Any, Any]:
    return np.array(value, np.float32)


SUM = "; y = ReduceSum h axes keepdims:1"
BINARY = {
    op: (f"h = {op} x row" + SUM, {"row": W[:, 0]})
    for op in ("Add", "Sub", "Mul", "Div", "Max", "Min", "Sum", "Mean", "PRelu")
}
REDUCTIONS: dict[str, tuple[str, Initializers]] = {
    op: (f"y = {op} x axes keepdims:1", {}) for op in OPERATORS if op.startswith("Reduce")
}
GRAPHS: dict[str, tuple[str, Initializers]] = {
    **BINARY,
    **REDUCTIONS,
    "Pow": ("h = Pow x two" + SUM, {"two": scalar(2.0)}),
    "Mod": ("h = Mod x m fmod:1" + SUM, {"m": scalar(0.3)}),
    "positive": (
        """a = Abs x; p = Add a one; l = Log p; s = Sqrt p; r = Reciprocal p; c = Acosh p
        h = Sum l s r c"""
        + SUM,
        {"one": scalar(1.0)},
    ),
    "comparisons": (
        """l = Less x row; le = LessOrEqual x row; g = Greater x row; ge = GreaterOrEqual x row; eq = Equal x row
        a = And l le; b = Or a g; c = Xor b ge; d = Not c; e = Or d eq; h = Where e x row"""
        + SUM,
        {"row": W[:, 0]},
    ),
    "whole numbers": (
        """s = Mul x hundred; i = Cast s to:7; m = Mod i seven; d = Div i seven
        b = BitwiseXor m d; c = BitwiseAnd b five; o = BitwiseOr c m; h = Cast o to:1"""
        + SUM,
        {"hundred": scalar(100), "seven": ints(7), "five": ints(5)},
    ),
    "Clip": (
        "a = Clip x low high; b = Clip a low; h = Clip b - high" + SUM,
        {"low": scalar(-0.3), "high": scalar(0.4)},
    ),
    "Gemm": (
        "h = Gemm x w b alpha:0.5 beta:2.0; k = Gemm h w transB:1; y = MatMul k e",
        {"w": W, "b": ROW, "e": np.ones((3, 1), np.float32)},
    ),
    "LayerNormalization": (
        "a = MatMul x w; h = LayerNormalization a s b epsilon:0.001; y = MatMul h e",
        {"w": W, "s": ROW, "b": ROW * 2, "e": np.arange(5, dtype=np.float32).reshape(5, 1)},
    ),
    "BatchNormalization": (
        "h = BatchNormalization x s b m v" + SUM,
        {"s": W[:, 0], "b": W[:, 1], "m": W[:, 2], "v": np.abs(W[:, 3]) + 1},
    ),
    "ArgMax": (
        """a = ArgMax x axis:1; i = ArgMin x axis:1 keepdims:0; j = Unsqueeze i one
        g = GatherElements x a axis:1; k = GatherElements x j axis:1; y = Sub g k""",
        {"one": ints(1)},
    ),
    "Concat Split Slice": (
        """c = Concat x x axis:-1; a b = Split c sizes axis:1; d = Slice b s e ax st; f = Slice d s2 e2 ax
        p q r = Split c axis:1 num_outputs:3; h = Mul q f; t = ReduceSum h axes keepdims:1
        u = ReduceSum a axes keepdims:1; y = Add t u""",
        {
            "sizes": ints(2, 4),
            "s": ints(-1),
            "e": ints(-(2**63)),
            "ax": ints(1),
            "st": ints(-1),
            "s2": ints(0),
            "e2": ints(2),
        },
    ),
    "shapes of shapes": (
        """s = Shape x; n = Gather s zero axis:0; t = Concat n three axis:0; c = ConstantOfShape t
        c1 = Add c half; m = Mul x c1; r = Reshape m six; f = Flatten r; g = Transpose f; g2 = Transpose g perm:[1,0]
        b = Reshape g2 back; h = Expand b t"""
        + SUM,
        {"zero": ints(0), "three": ints(3), "six": ints(-1, 1, 3), "back": ints(0, -1), "half": scalar(0.5)},
    ),
    "Unsqueeze Squeeze Tile": (
        "u = Unsqueeze x axes; t = Tile u reps; s = ReduceSum t axes keepdims:1; h = Squeeze s axes" + SUM,
        {"reps": ints(1, 4, 1)},
    ),
    "Range Constant Size": (
        """f = Constant value_floats:[1.0,2.0,3.0]; k = Constant value_int:3; r = Range zero k one; rf = Cast r to:1
        z = Size f; zf = Cast z to:1; a = Add f rf; b = Div a zf; h = Mul x b"""
        + SUM,
        {"zero": np.array(0), "one": np.array(1)},
    ),
    "Gather by value": (
        "a = Abs x; m = Mul a four; i = Cast m to:7; h = Gather table i" + SUM,
        {"four": scalar(4), "table": RNG.normal(size=100).astype(np.float32)},
    ),
    "GridSample": (
        """p = Reshape x place; s = GridSample grid p align_corners:1 padding_mode:"border"
        f = Reshape s flat; h = Transpose f perm:[1,0]"""
        + SUM,
        {"place": ints(1, 1, 1, -1, 3), "grid": GRID, "flat": ints(2, -1)},
    ),
}


@pytest.mark.parametrize("name", GRAPHS)
def test_graphs_agree_with_onnxruntime(name: str) -> None:
    text, initializers = GRAPHS[name]
    assert_agrees(model(text, initializers | {"axes": AXES}))


def test_constants_with_values_of_their_own() -> None:
    filled = nodes("c = ConstantOfShape three")[0]
    filled.attribute.append(
        onnx.helper.make_attribute("value", onnx.numpy_helper.from_array(np.array([0.5], np.float32)))
    )
    fixed = nodes("d = Constant")[0]
    fixed.attribute.append(onnx.helper.make_attribute("value", onnx.numpy_helper.from_array(W[:, 0])))
    assert_agrees(model([filled, fixed, *nodes("m = Mul x c; h = Mul m d" + SUM)], {"three": ints(3), "axes": AXES}))


def test_every_operator_is_tried() -> None:
    tried = set(ONE_BY_ONE.split()) | {n.op_type for text, _ in GRAPHS.values() for n in nodes(text)}
    assert OPERATORS.keys() == OPERATOR_FUNCTIONS.keys() == tried
    assert OPERATORS.keys() >= SHAPE_ONLY


def test_the_gradient_is_the_slope() -> None:
    text, initializers = GRAPHS["Gemm"]
    field = field_of(model("z = Sin x;" + text.replace("Gemm x", "Gemm z"), initializers))
    at, step = points(50).double(), 1e-3
    distance, gradient = field.signed_distance_and_gradient(at)
    torch.testing.assert_close(distance, field.signed_distance(at))
    for axis in range(3):
        aside = torch.zeros(3, dtype=torch.float64)
        aside[axis] = step
        slope = (field.signed_distance(at + aside) - field.signed_distance(at - aside)) / (2 * step)
        torch.testing.assert_close(slope, gradient[:, axis], rtol=5e-3, atol=5e-3)
    assert not gradient.requires_grad
    assert not distance.requires_grad


def test_a_step_has_no_slope() -> None:
    field = field_of(model("h = Floor x" + SUM, {"axes": AXES}))
    assert field.signed_distance_and_gradient(points(5))[1].abs().max() == 0.0
    by_way_of_whole_numbers = "i = Cast x to:7; h = Cast i to:1"
    field = field_of(model(by_way_of_whole_numbers + SUM, {"axes": AXES}))
    assert field.signed_distance_and_gradient(points(5))[1].abs().max() == 0.0


@pytest.mark.parametrize("count", [0, 1, 1023, 1024, 1025, 5000])
def test_any_number_of_points(count: int) -> None:
    field = field_of(sphere())
    at = points(count)
    distance, gradient = field.signed_distance_and_gradient(at)
    torch.testing.assert_close(distance, at.norm(dim=1) - 0.5, rtol=0, atol=1e-6)
    torch.testing.assert_close(gradient, at / at.norm(dim=1, keepdim=True), rtol=0, atol=1e-5)
    torch.testing.assert_close(field.to("cpu").signed_distance(at), distance)


def test_other_precisions_are_evaluated_in_single() -> None:
    proto = sphere(kind=onnx.TensorProto.DOUBLE)
    proto.graph.initializer[1].CopyFrom(onnx.numpy_helper.from_array(np.array(0.5), "half"))
    torch.testing.assert_close(field_of(proto).signed_distance(points()), points().norm(dim=1) - 0.5, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("text", "initializers"),
    [
        ("y = MatMul x w", {"w": W[:2, :1]}),
        ("y = MatMul x w", {"w": W}),  # five numbers a point
        ("y = Reshape x s", {"s": ints(7, 5)}),
        ("y = Tile x s", {"s": ints(1, 1 << 20)}),
        ("h = Expand x s" + SUM, {"s": ints(1 << 30, 1, 3), "axes": ints(0)}),
        (
            "i = Range zero many one; h = Cast i to:1; y = Add x h",
            {"zero": ints(0), "many": ints(1 << 30), "one": ints(1)},
        ),
        ("i = Cast x to:7; y = Gather w i", {"w": ROW}),
        ("y = BatchNormalization x w w w w training_mode:1", {"w": W[:, 0]}),
        ("h = Transpose x perm:[0,5]" + SUM, {"axes": AXES}),
        ("h = Cast x to:8" + SUM, {"axes": AXES}),  # text
    ],
)
def test_graphs_that_contradict_themselves(text: str, initializers: Initializers) -> None:
    """They are refused before a value is made that is larger than any may be."""
    with LargestStorage() as made, pytest.raises(FieldFormatError) as caught:
        field_of(model(text, initializers, made=None)).signed_distance(points(2000) * 50)
    assert caught.value.reason == "ONNX_GRAPH_INVALID"
    assert made.bytes <= 8 * MAX_ELEMENTS


class LargestStorage(TorchDispatchMode):
    """The memory of the largest tensor that any operation makes."""

    bytes = 0

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        made = function(*args, **(kwargs or {}))
        if isinstance(made, torch.Tensor):
            self.bytes = max(self.bytes, made.untyped_storage().nbytes())
        return made
