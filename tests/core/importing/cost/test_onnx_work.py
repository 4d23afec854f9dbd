"""The work of a graph is told before it is run: shapes as evaluated, and costly graphs refused at once."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest

from regnf_core.errors import FieldFormatError
from regnf_core.importing.families.onnx import convert_onnx
from regnf_core.importing.gate.convert import convert_file
from regnf_core.importing.gate.gate import import_field
from regnf_core.importing.gate.report import ImportLimits
from regnf_core.importing.upload_description import UploadDescription
from regnf_core.schema.kinds import OnnxDescription
from regnf_core.schema.safe_format import parse_description
from tests.core.fields.test_onnx import GRAPHS
from tests.core.importing.archives import assert_refused, saved
from tests.core.importing.onnx_models import Initializers, model

HALF: Initializers = {"axes": np.array([1]), "half": np.array(0.5, np.float32)}
SPHERE = "r = ReduceL2 x axes keepdims:1; s = Sub r half; "
LAST = "; k = ReduceSum {0} axes keepdims:1; t = Tanh k; y = Add s t"


def ints(*values: int) -> np.ndarray[Any, Any]:
    return np.array(values, np.int64)


def described(proto: onnx.ModelProto) -> tuple[OnnxDescription, dict[str, Any]]:
    found = convert_onnx(memoryview(proto.SerializeToString()), 1 << 30, UploadDescription())
    description = parse_description(found.description)
    assert isinstance(description, OnnxDescription)
    return description, dict(found.tensors)


def chain(operator: str, times: int, first: str) -> str:
    """``operator`` with {0} for what went before, so often; the last value is e<times>."""
    steps = (f"e{n + 1} = {operator.format(f'e{n}')}" for n in range(times))
    return f"{SPHERE}e0 = {first}; {'; '.join(steps)}"


def summed(first: str, steps: str, kept: str) -> str:
    """Values that no point is needed for; the sum of one of them is added to the sphere."""
    return f"{SPHERE}{first}; {steps}; c = ReduceSum {kept} keepdims:0; t = Tanh c; y = Add s t"


def repeated(step: str, times: int) -> str:
    """Steps that each begin at the same values; the value of step n is q<n>."""
    return "; ".join(f"q{n} = {step}" for n in range(times))


PRODUCTS = chain("MatMul {0} w", 60, "MatMul x b") + LAST.format("e60")
WHOLE_PRODUCTS = chain("MatMul {0} w", 20, "MatMul c b") + "; f = Cast e20 to:1" + LAST.format("f")
WIDE = "u = ConstantOfShape sh; w = Add u half; b = ConstantOfShape first; "
WHOLE = "c = Cast x to:7; u = ConstantOfShape sh; w = Cast u to:7; v = ConstantOfShape first; b = Cast v to:7; "
COSTLY: dict[str, tuple[str, Initializers]] = {
    "large products one after the other": (
        PRODUCTS.replace(SPHERE, SPHERE + WIDE),
        {"sh": ints(2048, 2048), "first": ints(3, 2048)},
    ),
    "products that no point is needed for": (
        chain("MatMul {0} {0}", 100, "ConstantOfShape sh") + "; k = ReduceSum e100 keepdims:0; t = Tanh k; y = Add s t",
        {"sh": ints(4000, 4000)},
    ),
    "products of whole numbers": (
        WHOLE_PRODUCTS.replace(SPHERE, SPHERE + WHOLE),
        {"sh": ints(1000, 1000), "first": ints(3, 1000)},
    ),
    "a value made wide": (chain("Sin {0}", 40, "Expand r wide") + LAST.format("e40"), {"wide": ints(1024, 16000)}),
    "a value tiled": (chain("Pow {0} half", 30, "Tile r wide") + LAST.format("e30"), {"wide": ints(1, 16000)}),
    "a value joined with itself": (
        chain("Concat {0} {0} axis:1", 11, "Concat x x axis:1")
        + f"; {repeated('Softmax e11 axis:0', 60)}"
        + LAST.format("q59"),
        {},
    ),
    "a long range": (
        summed("a = Range zero many one", repeated("Sin a", 300), "q7"),
        {name: np.array(value, np.float32) for name, value in (("zero", 0), ("many", 1.6e7), ("one", 1))},
    ),
    "many small matrices": (
        summed("a = ConstantOfShape many", repeated("MatMul a a", 300), "q7"),
        {"many": ints(1 << 22, 2, 2)},
    ),
    "a normalization that widens": (
        f"{SPHERE}w = ConstantOfShape wide; {repeated('BatchNormalization r w w w w', 30)}" + LAST.format("q29"),
        {"wide": ints(16000)},
    ),
}


def costly(name: str) -> bytes:
    text, initializers = COSTLY[name]
    return model(text, HALF | initializers).SerializeToString()


@pytest.mark.parametrize("name", COSTLY)
def test_costly_graphs_are_refused_before_anything_is_evaluated(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each is a small file that would take minutes: the run that tells it ends where it is too much."""
    monkeypatch.setattr("regnf_core.fields.build.open_field", lambda _: pytest.fail("it was opened"))
    path = saved(tmp_path, costly(name))
    assert path.stat().st_size < 12_000
    assert_refused(lambda: convert_file(path, tmp_path, None, ImportLimits(wall_s=100, work_s=6)), "IMPORT_TOO_COSTLY")
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


def test_a_costly_graph_through_the_gate_says_both_numbers(tmp_path: Path) -> None:
    path = saved(tmp_path, costly("large products one after the other"))
    assert path.stat().st_size < 2_000
    with pytest.raises(FieldFormatError, match=r"estimated \d+ s of processor time; 60 s are allowed") as caught:
        import_field(path, tmp_path / "out", None, ImportLimits(wall_s=100))
    assert caught.value.reason == "IMPORT_TOO_COSTLY"


def test_the_limit_is_the_callers(tmp_path: Path) -> None:
    text, initializers = GRAPHS["Gemm"]
    path = saved(tmp_path, model(text, initializers | HALF).SerializeToString())
    assert_refused(
        lambda: convert_file(path, tmp_path, None, ImportLimits(wall_s=100, work_s=1e-3)), "IMPORT_TOO_COSTLY"
    )


UNTOLD: dict[str, tuple[str, Initializers]] = {
    "a number of elements that a large array decides": (
        "b = ConstantOfShape many; n = ArgMax b axis:0 keepdims:1; e = Expand r n; y = Add s e",
        {"many": ints(100_000)},
    ),
    "a range without an end": ("a = Range half half zero; y = Add s a", {"zero": np.array(0, np.float32)}),
    "a length beyond all": ("a = Tile r many; y = Add s a", {"many": ints(2**62, 2**62)}),
    "a length below zero": ("a = ConstantOfShape many; y = Add s a", {"many": ints(-5)}),
    "a filling beyond all": ("a = ConstantOfShape many; y = Add s a", {"many": ints(2**31, 2**31, 2**31)}),
    "a difference of truth values": ("a = Greater r half; b = Sub a a; c = Cast b to:1; y = Add s c", {}),
    "the opposite of a truth value": ("a = Greater r half; b = Neg a; c = Cast b to:1; y = Add s c", {}),
    "a division by zero": ("a = Div i zero; b = Cast a to:1; y = Add s b", {"i": ints(1), "zero": ints(0)}),
    "a rest of a division by zero": ("a = Mod i zero; b = Cast a to:1; y = Add s b", {"i": ints(1), "zero": ints(0)}),
    "an index beyond the end": ("a = Gather x i axis:1; y = Add s a", {"i": ints(2**62)}),
    "an axis beyond all": ("a = Unsqueeze x i; y = Add s a", {"i": ints(2**62)}),
    "an axis that is text": ('a = Split x axis:"k" num_outputs:3; y = Add s a', {}),
    "a step of zero": ("a = Slice x i j i i; y = Add s a", {"i": ints(0), "j": ints(1)}),
    "parts below zero": ("a b = Split x i axis:1; y = Add s a", {"i": ints(-1, 4)}),
    "an empty grid": (
        "v = ConstantOfShape e; g = ConstantOfShape h; a = GridSample v g; b = Reshape a half; y = Add s b",
        {"e": ints(1, 1, 0, 0), "h": ints(1, 32, 32, 2)},
    ),
}


@pytest.mark.parametrize("name", UNTOLD)
def test_graphs_whose_values_cannot_be_told_are_refused(name: str, tmp_path: Path) -> None:
    text, initializers = UNTOLD[name]
    path = saved(tmp_path, model(SPHERE + text, HALF | initializers).SerializeToString())
    assert_refused(lambda: convert_file(path, tmp_path, None, ImportLimits()), "ONNX_GRAPH_INVALID")


LOWEST = np.iinfo(np.int64).min
TRAPS = {
    "known": "a{0} = Div low minus",
    "of a real number": "i{0} = Cast far to:7; a{0} = Div i{0} minus",
    "at every point": "i{0} = Cast r to:7; z{0} = Sub i{0} i{0}; k{0} = Add z{0} low; a{0} = Div k{0} minus",
    "the rest": "a{0} = Mod low minus",
    "the other rest": "a{0} = Mod low minus fmod:1",
}
"""What divides the lowest whole number by minus one; each result is then multiplied by nothing and added."""


def test_the_lowest_whole_number_by_minus_one_does_not_end_the_process(tmp_path: Path) -> None:
    steps = []
    for n, trap in enumerate(TRAPS.values()):
        before, total = f"t{n - 1}" if n else "s", f"t{n}" if n < len(TRAPS) - 1 else "y"
        steps += [trap.format(n), f"b{n} = Mul a{n} none", f"c{n} = Cast b{n} to:1", f"{total} = Add {before} c{n}"]
    values = {"low": ints(LOWEST), "minus": ints(-1), "none": ints(0), "far": np.array([-1e30], np.float32)}
    path = saved(tmp_path, model(SPHERE + "; ".join(steps), HALF | values).SerializeToString())
    assert import_field(path, tmp_path / "out").family == "onnx"


@pytest.mark.parametrize("shape", [(2**62,), (2**62, 0), (2**31, 2**31, 0, 4), (0, 2**62), (2**32, 2)])
@pytest.mark.parametrize("kind", [onnx.TensorProto.FLOAT, onnx.TensorProto.INT64, onnx.TensorProto.BOOL])
def test_weights_of_impossible_shapes(shape: tuple[int, ...], kind: int, tmp_path: Path) -> None:
    proto = model(SPHERE + "y = Identity s", HALF)
    weight = proto.graph.initializer.add()
    weight.name, weight.data_type = "w", kind
    weight.dims.extend(shape)
    path = saved(tmp_path, proto.SerializeToString())
    assert_refused(lambda: convert_file(path, tmp_path, None, ImportLimits()), "ONNX_MALFORMED")
