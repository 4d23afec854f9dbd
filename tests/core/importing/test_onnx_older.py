"""ONNX models of operator sets 9 to 12, and models of several columns, against ONNX's own reference evaluation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from onnx.reference import ReferenceEvaluator

from regnf_core.fields.build import open_field
from regnf_core.importing.gate.convert import FIELD_NAME
from tests.core.importing.archives import assert_refused, saved
from tests.core.importing.in_process import convert
from tests.core.importing.onnx_models import Initializers, model, nodes

_rng = np.random.default_rng(3)
WEIGHTS: Initializers = {
    "w": _rng.normal(size=(3, 8)).astype(np.float32),
    "b": _rng.normal(size=8).astype(np.float32),
    "v": _rng.normal(size=(8, 1)).astype(np.float32),
    "half": np.array(0.5, np.float32),
}
CASES: dict[str, tuple[int, str]] = {
    "clip by attributes": (9, "h = Gemm x w b; c = Clip h min:-0.4 max:0.6; y = MatMul c v"),
    "clip from above": (10, "h = Gemm x w b; c = Clip h max:0.2; y = MatMul c v"),
    "clip by inputs": (11, "h = Gemm x w b; c = Clip h half; y = MatMul c v"),
    "softmax of what follows an axis": (
        12,
        "h = Gemm x w b; u = Unsqueeze h axes:[1]; s = Softmax u axis:2; q = Squeeze s axes:[1]; y = MatMul q v",
    ),
    "softmax of all": (9, "h = Gemm x w b; s = Softmax h axis:1; y = MatMul s v"),
    "softmax by default": (11, "h = Gemm x w b; s = LogSoftmax h; y = MatMul s v"),
    "slices by attributes": (9, "h = Gemm x w b; s = Slice h axes:[1] starts:[2] ends:[3]; y = Sub s half"),
    "sums by attributes": (12, "r = ReduceSum x axes:[1] keepdims:1; y = Sub r half"),
    "dropout and split": (
        10,
        "h = Gemm x w b; d = Dropout h ratio:0.3; p q = Split d axis:1 split:[1,7]; y = Tanh p",
    ),
}


@pytest.fixture
def generator() -> np.random.Generator:
    """A generator for each test: its points do not depend on which tests ran before it."""
    return np.random.default_rng(4)


def reference(proto: onnx.ModelProto, points: Any) -> Any:
    return ReferenceEvaluator(proto).run(None, {"x": points.astype(np.float32)})[0]


@pytest.mark.parametrize("case", CASES)
def test_older_operators_mean_what_they_meant(case: str, tmp_path: Path, generator: np.random.Generator) -> None:
    opset, body = CASES[case]
    proto = model(nodes(body), WEIGHTS, opset=opset)
    middle = reference(proto, generator.uniform(-1.0, 1.0, (64, 3)))
    shift = np.array(np.median(middle), np.float32)
    proto = model(
        nodes(body.replace("y =", "before =") + "; y = Sub before shift"), WEIGHTS | {"shift": shift}, opset=opset
    )
    report = convert(saved(tmp_path, proto.SerializeToString()), tmp_path / "out")
    assert f"operator set {opset}" in report["why"][0]
    points = generator.uniform(-1.0, 1.0, (50, 3)).astype(np.float32)
    found = open_field(tmp_path / "out" / FIELD_NAME).signed_distance(torch.from_numpy(points))
    expected = reference(proto, points)[:, 0]
    # both compute in float32: four roundings of the largest value before the shift, and never less than 2e-6
    rounding = np.spacing(np.abs(expected + shift).max(), dtype=np.float32)
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-7, atol=max(2e-6, 4 * float(rounding)))


def wide(column: int, slope: float = 1.0) -> onnx.ModelProto:
    """Four columns; of them one is the distance to a ball, times ``slope``, the others are coordinates."""
    columns = ["px", "py", "pz"]
    columns.insert(column, "d")
    body = (
        "r = ReduceL2 x axes:[1] keepdims:1; e = Sub r half; d = Mul e slope; px py pz = Split x axis:1; "
        f"y = Concat {' '.join(columns)} axis:1"
    )
    return model(nodes(body), {"half": WEIGHTS["half"], "slope": np.array(slope, np.float32)}, made=("n", 4), opset=11)


@pytest.mark.parametrize(("column", "said"), [(0, {}), (0, {"output_column": 0}), (2, {"output_column": 2})])
def test_one_column_of_several(
    column: int, said: dict[str, Any], tmp_path: Path, generator: np.random.Generator
) -> None:
    convert(saved(tmp_path, wide(column).SerializeToString()), tmp_path / "out", said)
    points = generator.uniform(-1.0, 1.0, (50, 3)).astype(np.float32)
    found = open_field(tmp_path / "out" / FIELD_NAME).signed_distance(torch.from_numpy(points))
    np.testing.assert_allclose(found.numpy(), np.linalg.norm(points, axis=1) - 0.5, atol=1e-6)


@pytest.mark.parametrize(
    ("proto", "said", "reason"),
    [
        (wide(0, slope=0.3), {}, "LAYOUT_AMBIGUOUS"),
        (wide(0), {"output_column": 4}, "SETTINGS_CONTRADICT_TENSORS"),
        (wide(0), {"output_tanh": 1}, "INVALID_DESCRIPTION"),
        (model("r = ReduceL2 x axes:[1] keepdims:0; y = Sub r half", {"half": WEIGHTS["half"]}, made=("n",), opset=12),
         {"output_column": 1}, "SETTINGS_CONTRADICT_TENSORS"),
        (model("y = Identity x", made=("n", 3), opset=8), {}, "ONNX_NOT_SUPPORTED"),
    ],
)  # fmt: skip
def test_a_column_that_is_no_distance(
    proto: onnx.ModelProto, said: dict[str, Any], reason: str, tmp_path: Path
) -> None:
    assert_refused(lambda: convert(saved(tmp_path, proto.SerializeToString()), tmp_path / "out", said), reason)
