"""The operators of ONNX that a field may be made of, and what each may be given. Torch-free.

Left out on purpose: control flow, random numbers, strings, sequences, and whatever makes shapes out of values.
"""

from __future__ import annotations

from dataclasses import dataclass

MAX_ELEMENTS = 1 << 24
"""Elements that any value of the graph may have, for one batch."""
_MANY = 64


@dataclass(frozen=True)
class Signature:
    """Least and most inputs, most outputs, and which inputs must follow from the model alone, not from the points."""

    least: int
    most: int
    outputs: int = 1
    settled: tuple[int, ...] = ()
    """They decide over shapes: so every shape in the graph is the same for every batch of points."""


def _table() -> dict[str, Signature]:
    one, two, three = Signature(1, 1), Signature(2, 2), Signature(3, 3)
    unary = (
        "Abs Acos Acosh Asin Asinh Atan Atanh Cast Ceil Celu Cos Cosh Elu Erf Exp Floor Gelu HardSigmoid HardSwish "
        "Identity LeakyRelu Log LogSoftmax Mish Neg Not Reciprocal Relu Round Selu Shape Sigmoid Sign Sin Sinh Size "
        "Softmax Softplus Softsign Sqrt Tan Tanh ThresholdedRelu Flatten Transpose ArgMax ArgMin"
    )
    binary = (
        "Add And BitwiseAnd BitwiseOr BitwiseXor Div Equal Gather GatherElements Greater GreaterOrEqual Less "
        "LessOrEqual MatMul Mod Mul Or PRelu Pow Sub Xor GridSample"
    )
    reductions = "ReduceL1 ReduceL2 ReduceLogSumExp ReduceMax ReduceMean ReduceMin ReduceProd ReduceSum ReduceSumSquare"
    return {
        **dict.fromkeys(unary.split(), one),
        **dict.fromkeys(binary.split(), two),
        **dict.fromkeys(reductions.split(), Signature(1, 2, settled=(1,))),
        **dict.fromkeys(("Concat", "Max", "Mean", "Min", "Sum"), Signature(1, _MANY)),
        "Where": three,
        "Gemm": Signature(2, 3),
        "BatchNormalization": Signature(5, 5),
        "LayerNormalization": Signature(2, 3),
        "Clip": Signature(1, 3),
        "Dropout": Signature(1, 3, settled=(1, 2)),
        "Constant": Signature(0, 0),
        "ConstantOfShape": Signature(1, 2, settled=(0, 1)),
        "Expand": Signature(2, 2, settled=(1,)),
        "Range": Signature(3, 3, settled=(0, 1, 2)),
        "Reshape": Signature(2, 2, settled=(1,)),
        "Slice": Signature(1, 5, settled=(1, 2, 3, 4)),
        "Split": Signature(1, 2, outputs=_MANY, settled=(1,)),
        "Squeeze": Signature(1, 2, settled=(1,)),
        "Tile": Signature(2, 2, settled=(1,)),
        "Unsqueeze": Signature(1, 2, settled=(1,)),
    }


OPERATORS: dict[str, Signature] = _table()
SHAPE_ONLY = frozenset({"Shape", "Size"})
"""Their results depend on the shape of what they are given, not on its values."""
