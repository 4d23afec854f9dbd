"""The memory of a graph is told before it is run, and a value is let go of after its last use."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from regnf_core.errors import FieldFormatError
from regnf_core.fields.onnx import graph
from regnf_core.importing.cost.mesh_work import Calls
from regnf_core.importing.cost.onnx_work import onnx_needs
from regnf_core.importing.gate.convert import convert_file
from regnf_core.importing.gate.report import MIB, ImportLimits
from regnf_core.schema.kinds import OnnxDescription, last_uses
from tests.core.importing.archives import saved
from tests.core.importing.cost.test_onnx_work import HALF, LAST, SPHERE, chain, described, ints
from tests.core.importing.onnx_models import model

COUNT = 120
LARGE = 64 * MIB
MADE = [f"c{n} = ConstantOfShape wide" for n in range(COUNT)]
SUMMED = [f"d{n} = ReduceSum c{n} keepdims:0" for n in range(COUNT)]
ADDED = ["e0 = Add d0 d1", *(f"e{n} = Add e{n - 1} d{n + 1}" for n in range(1, COUNT - 1)), f"z = Tanh e{COUNT - 2}"]
WIDE = HALF | {"wide": ints(1 << 24)}


def onnx_bytes(description: OnnxDescription, tensors: dict[str, Any]) -> int:
    return onnx_needs(description, tensors, Calls((1,), ()))[1]


def graph_of(steps: list[str]) -> Any:
    return model(SPHERE + "; ".join([*steps, *ADDED, "y = Add s z"]), WIDE)


def test_values_that_are_alive_at_once_are_refused_before_they_are_made(tmp_path: Path) -> None:
    """120 of 64 MiB, in a file of a few kilobytes that takes half a minute of work."""
    path = saved(tmp_path, graph_of(MADE + SUMMED).SerializeToString())
    with pytest.raises(FieldFormatError, match=r"an estimated \d+ MiB of memory; \d+ MiB are free") as caught:
        convert_file(path, tmp_path, None, ImportLimits())
    assert caught.value.reason == "IMPORT_TOO_COSTLY"
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


def test_values_that_are_alive_one_after_the_other_take_the_room_of_few() -> None:
    description, tensors = described(graph_of([step for pair in zip(MADE, SUMMED, strict=True) for step in pair]))
    assert LARGE < onnx_bytes(description, tensors) < 4 * LARGE
    description, tensors = described(graph_of(MADE + SUMMED))
    assert COUNT * LARGE < onnx_bytes(description, tensors) < (COUNT + 4) * LARGE


def test_what_depends_on_the_points_is_kept_for_the_gradient() -> None:
    text = chain("Sin {0}", 30, "Expand r wide") + LAST.format("e30")
    description, tensors = described(model(text, HALF | {"wide": ints(1024, 1000)}))
    each = 4 * 1024 * 1000
    assert 31 * 2 * each < onnx_bytes(description, tensors) < 34 * 2 * each


def test_whole_numbers_take_twice_the_room() -> None:
    sizes = []
    for kind in (1, 7):
        text = f"{SPHERE}c = ConstantOfShape wide; i = Cast c to:{kind}; d = ReduceSum i keepdims:0; "
        sizes.append(onnx_bytes(*described(model(text + "f = Cast d to:1; y = Add s f", WIDE))))
    assert sizes[1] - sizes[0] > LARGE


def test_a_value_is_let_go_of_after_its_last_use(monkeypatch: pytest.MonkeyPatch) -> None:
    held: list[int] = []
    run_step = graph.run_step

    def counted(step: graph.Step, values: Any) -> Any:
        held.append(len(values))
        return run_step(step, values)

    monkeypatch.setattr(graph, "run_step", counted)
    constants = "; ".join(f"c{n} = {f'Sin c{n - 1}' if n else 'Sin half'}" for n in range(40))
    text = chain("Sin {0}", 40, "Add r half") + f"; {constants}; z = Add e40 c39; y = Add s z"
    description, tensors = described(model(text, HALF))
    field = graph.build_onnx(description, {name: torch.from_numpy(array) for name, array in tensors.items()})
    points = torch.rand(10, 3, generator=torch.Generator().manual_seed(0))
    moving, constant = points.double().norm(dim=1) + 0.5, np.float64(0.5)
    for _ in range(40):
        moving, constant = moving.sin(), np.sin(constant)
    expected = points.double().norm(dim=1) - 0.5 + moving + constant
    torch.testing.assert_close(field.signed_distance(points).double(), expected, rtol=0, atol=1e-5)
    field.signed_distance_and_gradient(points)
    assert max(held) < 12


def test_a_last_use_is_the_last() -> None:
    body = "a = Neg x; b = Neg a; c = Add a b; r = ReduceL2 c axes keepdims:1; y = Sub r half"
    description, _ = described(model(body, HALF))
    uses = [set(names) for names in last_uses(description.nodes, description.output)]
    first, second, third, fourth, _ = (node.outputs[0] for node in description.nodes)
    assert uses[:3] == [{description.input}, set(), {first, second}]
    assert third in uses[3]
    assert fourth in uses[4]
    assert description.output not in set().union(*uses)
