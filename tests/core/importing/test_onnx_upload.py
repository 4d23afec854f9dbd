"""ONNX models as uploads: what is taken, and everything that is refused before a number of it is used."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from regnf_core.fields.build import open_field
from regnf_core.importing.containers.sniff import sniff_format
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.families.onnx import convert_onnx
from regnf_core.importing.onnx import model as reader
from regnf_core.importing.upload_description import UploadDescription
from regnf_core.schema.safe_format import write_safe_field
from tests.core.importing.archives import assert_refused, saved
from tests.core.importing.in_process import convert
from tests.core.importing.onnx_models import model, nodes, sphere

BUDGET = 1 << 20
HALF = {"half": np.array(0.5, np.float32), "axes": np.array([1])}
Change = Callable[[onnx.ModelProto], None]


def converted(proto: onnx.ModelProto, said: dict[str, object] | None = None) -> ConvertedField:
    data = proto.SerializeToString()
    assert sniff_format(data[:512]) == "onnx"
    return convert_onnx(memoryview(data), BUDGET, UploadDescription.from_dict(said))


class Network(nn.Module):
    """A small network with sines and cosines; a sphere, nearly."""

    def __init__(self) -> None:
        super().__init__()
        self.first, self.second = nn.Linear(27, 32), nn.Linear(32, 1)

    def forward(self, points: Tensor) -> Tensor:
        angles = (points[..., None] * 2.0 ** torch.arange(4)).flatten(1)
        hidden = nn.functional.softplus(self.first(torch.cat([points, angles.sin(), angles.cos()], dim=-1)), beta=100)
        return points.norm(dim=-1, keepdim=True) - 0.5 + 0.05 * self.second(hidden)


def test_a_model_whose_few_numbers_are_all_constants_is_taken(tmp_path: Path) -> None:
    """Its field file holds no tensor; and may be uploaded again. Through the gate's process: cost/test_onnx_work.py."""
    report = convert(saved(tmp_path, sphere().SerializeToString()), tmp_path / "out")
    assert (report["family"], report["parameters"]) == ("onnx", 0)
    again = convert(tmp_path / "out" / "field.safetensors", tmp_path / "again")
    assert again["plausibility"] == report["plausibility"]


@pytest.mark.parametrize("exporter", [pytest.param("of today", marks=pytest.mark.long), "of before"])
def test_a_network_exported_by_torch_is_that_network(exporter: str, tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = Network().eval()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if exporter == "of today":  # as docs/families.md has it
            shapes = {"points": {0: torch.export.Dim("n")}}
            torch.onnx.export(
                network, (torch.zeros(8, 3),), tmp_path / "net.onnx", dynamic_shapes=shapes, external_data=False
            )
        else:
            names = {"input_names": ["points"], "dynamic_axes": {"points": {0: "n"}}}
            torch.onnx.export(network, (torch.zeros(8, 3),), str(tmp_path / "net.onnx"), dynamo=False, **names)
    report = convert(tmp_path / "net.onnx", tmp_path / "out", {"bounds": [[-1, -1, -1], [1, 1, 1]], "label": "ball"})
    assert (report["family"], report["label"], report["warnings"]) == ("onnx", "ball", [])
    assert 0 <= report["parameters"] - (27 * 32 + 32 + 32) < 20  # a few constants of the encoding too
    at = (2 * torch.rand(3000, 3) - 1).requires_grad_()
    expected = network(at)[:, 0]
    (slope,) = torch.autograd.grad(expected.sum(), at)
    distance, gradient = open_field(tmp_path / "out" / "field.safetensors").signed_distance_and_gradient(at.detach())
    torch.testing.assert_close(distance, expected.detach(), rtol=0, atol=2e-6)
    torch.testing.assert_close(gradient, slope, rtol=0, atol=2e-5)


def test_the_report_says_how_it_is_evaluated() -> None:
    open_number, fixed, single = (converted(sphere(given=(n, 3), made=(n, 1))) for n in ("n", 512, 1))
    assert [found.description["batch"] for found in (open_number, fixed, single)] == [1024, 512, 1024]
    assert "made for 1 points" in single.why[1]
    assert [warning.split(":")[0] for warning in open_number.warnings] == ["BOUNDS_ASSUMED"]
    assert converted(sphere(), {"bounds": [[-1, -1, -1], [1, 1, 1]], "sign": -1}).warnings == ()
    assert converted(sphere(given=None, made=None)).description["batch"] == 1024


def test_a_field_that_mixes_its_points_is_none(tmp_path: Path) -> None:
    """And a graph of another size than it says is refused too."""
    mixed = "r = ReduceL2 x axes keepdims:1; m = ReduceMean r zero keepdims:1; y = Sub r m"
    other = "f = Reshape x one; r = ReduceL2 f axes keepdims:1; y = Sub r half"
    values = {"zero": np.array([0]), "one": np.array([1, 3])}
    for number, (body, reason) in enumerate(((mixed, "FIELD_NOT_A_FUNCTION"), (other, "ONNX_GRAPH_INVALID"))):
        upload, out = saved(tmp_path, model(body, HALF | values).SerializeToString()), tmp_path / f"out{number}"
        assert_refused(partial(convert, upload, out), reason)


def external(proto: onnx.ModelProto) -> None:
    tensor = proto.graph.initializer[0]
    onnx.external_data_helper.set_external_data(tensor, "../../secret.bin")
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL


def add_node(text: str, domain: str = "") -> Change:
    def change(proto: onnx.ModelProto) -> None:
        extra = nodes(text)[0]
        extra.domain = domain
        proto.graph.node.insert(0, extra)

    return change


def add_branch(proto: onnx.ModelProto) -> None:
    branch = helper.make_graph(nodes("z = Identity x"), "b", [], [helper.make_tensor_value_info("z", 1, None)])
    proto.graph.node.insert(0, helper.make_node("If", ["c"], ["z"], then_branch=branch, else_branch=branch))


def add_weight(name: str, values: np.ndarray[tuple[int, ...], np.dtype[np.float32]]) -> Change:
    return lambda proto: proto.graph.initializer.append(numpy_helper.from_array(values, name))


def lie(proto: onnx.ModelProto) -> None:
    proto.graph.initializer[1].dims[:] = [1 << 20, 1 << 20]


def many_nodes(proto: onnx.ModelProto) -> None:
    proto.graph.node.extend(nodes("z = Identity x")[0] for _ in range(reader.MAX_NODES))


def weight_by_name(proto: onnx.ModelProto) -> None:
    proto.graph.initializer[1].name = "x"


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (external, "ONNX_EXTERNAL_DATA"),
        (add_branch, "ONNX_NOT_SUPPORTED"),
        (add_node("z = Loop x x x"), "ONNX_NOT_SUPPORTED"),
        (add_node("z = Scan x"), "ONNX_NOT_SUPPORTED"),
        (add_node("z = NonZero x"), "ONNX_NOT_SUPPORTED"),
        (add_node("z = RandomNormal"), "ONNX_NOT_SUPPORTED"),
        (add_node('z = Constant value_string:"text"'), "ONNX_GRAPH_INVALID"),
        (add_node("z = Identity x", domain="com.example"), "ONNX_NOT_SUPPORTED"),
        (add_node("z = Identity w"), "ONNX_NOT_SUPPORTED"),  # made by nobody
        (add_node("x = Identity x"), "ONNX_NOT_SUPPORTED"),  # made twice
        (add_node("z = Relu x x"), "FIELD_SHAPES_MISMATCH"),
        (add_node("z1 z2 = Relu x"), "FIELD_SHAPES_MISMATCH"),
        (add_node("z = Elu x alpha:1e39"), "ONNX_NOT_SUPPORTED"),
        (add_weight("w", np.zeros((1 << 10, 1 << 10), np.float32)), "TENSOR_TOO_LARGE"),
        (add_weight("half", np.zeros(1, np.float32)), "ONNX_MALFORMED"),  # two of one name
        (add_weight("w", np.full(100, np.nan, np.float32)), "TENSOR_NOT_FINITE"),
        (add_weight("w", np.zeros(3, np.complex64)), "TENSOR_DTYPE"),  # type: ignore[arg-type]
        (lie, "ONNX_MALFORMED"),
        (many_nodes, "ONNX_NOT_SUPPORTED"),
        (weight_by_name, "ONNX_NOT_SUPPORTED"),  # no input is left
        (lambda p: p.graph.input.append(helper.make_tensor_value_info("z", 1, ["n"])), "ONNX_NOT_SUPPORTED"),
        (lambda p: p.graph.output.append(helper.make_tensor_value_info("r", 1, ["n", 1])), "ONNX_NOT_SUPPORTED"),
        (lambda p: p.graph.output.pop(), "ONNX_NOT_SUPPORTED"),
        (lambda p: p.graph.sparse_initializer.add(), "ONNX_NOT_SUPPORTED"),
        (lambda p: p.graph.quantization_annotation.add(), "ONNX_NOT_SUPPORTED"),
        (lambda p: p.training_info.add(), "ONNX_NOT_SUPPORTED"),
        (lambda p: p.functions.add(), "ONNX_NOT_SUPPORTED"),
        (lambda p: p.ClearField("graph"), "ONNX_MALFORMED"),
        (lambda p: p.ClearField("opset_import"), "ONNX_NOT_SUPPORTED"),
    ],
)
def test_models_that_are_refused(change: Change, reason: str, tmp_path: Path) -> None:
    proto = sphere()
    change(proto)

    def convert() -> None:
        found = converted(proto)
        write_safe_field(tmp_path / "field", found.description, found.tensors)
        open_field(tmp_path / "field")

    assert_refused(convert, reason)


@pytest.mark.parametrize(
    ("given", "made", "kind"),
    [
        ((1, "n", 3), ("n", 1), TensorProto.FLOAT),
        (("n", 2), ("n", 1), TensorProto.FLOAT),
        (("n", 3), ("n", 257, 1), TensorProto.FLOAT),
        (("n", 3), (1, "n", 1), TensorProto.FLOAT),
        (("n", 3), ("n", 1), TensorProto.INT64),
    ],
)
def test_functions_of_something_else(given: tuple[int | str, ...], made: tuple[int | str, ...], kind: int) -> None:
    assert_refused(lambda: converted(sphere(given=given, made=made, kind=kind)), "ONNX_NOT_SUPPORTED")


def test_shapes_that_depend_on_the_points(tmp_path: Path) -> None:
    proto = model("i = Cast x to:7; f = Reshape i m1; e = Expand half f; y = Sub e half", HALF | {"m1": np.array([-1])})
    found = converted(proto)
    assert_refused(lambda: write_safe_field(tmp_path / "f", found.description, found.tensors), "FIELD_SHAPES_MISMATCH")


def test_an_old_operator_set() -> None:
    assert_refused(lambda: converted(sphere(opset=8)), "ONNX_NOT_SUPPORTED")
