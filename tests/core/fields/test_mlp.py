"""The kind ``mlp``: against a slow evaluation in float64, and the shapes that its descriptions ask for."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from regnf_core.fields.build import build_field, open_field
from regnf_core.fields.observation import SdfField, differentiable_signed_distance
from regnf_core.schema.safe_format import parse_description, write_safe_field
from tests.core.fields.reference import central_differences
from tests.core.importing.archives import assert_refused

Array = NDArray[Any]
HIDDEN = (24, 20, 24, 24)
PLAIN: dict[str, Any] = {"activation": "softplus"}
CASES: dict[str, dict[str, Any]] = {
    "softplus": PLAIN,
    "relu": {"activation": "relu"},
    "sine": {"activation": "sine"},
    "skips": {"activation": "softplus", "input_at": [2, 4]},
    "sines and cosines": {
        "activation": "softplus",
        "positional_encoding": {"degree": 4, "two_pi": False},
        "input_at": [3],
    },
    "2 pi, unused": {
        "activation": "softplus",
        "positional_encoding": {"degree": 2, "two_pi": True, "used": False},
        "input_at": [1],
    },
    "normalized": {"activation": "relu", "normalized": [0, 1, 3], "input_at": [2], "output_tanh": 1},
    "tanh twice": {"activation": "sine", "output_tanh": 2},
    "tanh between": {"activation": "tanh", "input_at": [2]},
    "elu": {"activation": "elu"},
    "gelu": {"activation": "gelu", "normalized": [1]},
    "silu": {"activation": "silu", "input_at": [1]},
    "leaky_relu": {"activation": "leaky_relu"},
    "leaky_relu of another slope": {"activation": "leaky_relu", "negative_slope": 0.2, "input_at": [3]},
}


def description(**changes: Any) -> dict[str, Any]:
    return {"kind": "mlp", "bounds": [[-1.0] * 3, [1.0] * 3]} | changes


def encoding_width(values: dict[str, Any]) -> int:
    return 6 * (values.get("positional_encoding") or {"degree": 0})["degree"]


def tensors(values: dict[str, Any]) -> dict[str, Array]:
    """Random layers that fit a description; the last has three rows."""
    rng = np.random.default_rng(3)
    inputs = 3 + encoding_width(values)
    made, columns = {}, inputs
    for i, rows in enumerate((*HIDDEN, 3)):
        columns += inputs if i in values.get("input_at", ()) else 0
        made[f"layers.{i}.weight"] = (1.5 * rng.normal(size=(rows, columns)) / math.sqrt(columns)).astype(np.float32)
        made[f"layers.{i}.bias"] = (0.2 * rng.normal(size=rows)).astype(np.float32)
        if i in values.get("normalized", ()):
            made[f"norms.{i}.weight"] = rng.uniform(0.5, 1.5, rows).astype(np.float32)
            made[f"norms.{i}.bias"] = (0.2 * rng.normal(size=rows)).astype(np.float32)
        columns = rows
    return made


def slowly(values: dict[str, Any], stored: dict[str, Array], point: Array) -> float:
    """The distance at one point (3,), layer by layer, in float64."""
    encoding = values.get("positional_encoding")
    waves: Array = np.zeros(encoding_width(values))
    if encoding is not None and encoding.get("used", True):
        factor = 2.0 * math.pi if encoding["two_pi"] else 1.0
        angles = [factor * 2.0**k * point[axis] for axis in range(3) for k in range(encoding["degree"])]
        waves = np.concatenate((np.sin(angles), np.cos(angles)))
    inputs: Array = np.concatenate((point, waves))
    h = inputs
    activations: dict[str, Callable[[Array], Array]] = {
        "relu": lambda a: np.maximum(a, 0.0),
        "softplus": lambda a: np.logaddexp(100.0 * a, 0.0) / 100.0,
        "sine": np.sin,
        "tanh": np.tanh,
        "elu": lambda a: np.where(a > 0.0, a, np.expm1(np.minimum(a, 0.0))),
        "gelu": lambda a: a * np.array([0.5 * math.erfc(-each / math.sqrt(2.0)) for each in a]),
        "silu": lambda a: a / (1.0 + np.exp(-a)),
        "leaky_relu": lambda a: np.where(a > 0.0, a, values.get("negative_slope", 0.01) * a),
    }
    for i in range(5):
        if i in values.get("input_at", ()):
            h = np.concatenate((h, inputs))
        h = stored[f"layers.{i}.weight"].astype(np.float64) @ h + stored[f"layers.{i}.bias"]
        if i in values.get("normalized", ()):
            h = (h - h.mean()) / np.sqrt(h.var() + 1e-5) * stored[f"norms.{i}.weight"] + stored[f"norms.{i}.bias"]
        if i < 4:
            h = activations[values["activation"]](h)
    distance = h[0]
    for _ in range(values.get("output_tanh", 0)):
        distance = np.tanh(distance)
    return float(distance)


def built(values: dict[str, Any]) -> SdfField:
    parsed = parse_description(description(**values))
    return build_field(parsed, {name: torch.from_numpy(array) for name, array in tensors(values).items()})


@pytest.mark.parametrize("case", CASES)
def test_agrees_with_a_slow_evaluation_and_survives_its_file(case: str, tmp_path: Path) -> None:
    values = CASES[case]
    stored = tensors(values)
    points = np.random.default_rng(4).uniform(-1.2, 1.2, (20, 3))
    field = built(values)
    distance, gradient = field.signed_distance_and_gradient(torch.from_numpy(points))
    exact = points.astype(np.float32).astype(np.float64)
    np.testing.assert_allclose(distance.numpy(), [slowly(values, stored, p) for p in exact], atol=1e-5)
    expected = np.stack([central_differences(lambda p: slowly(values, stored, p), p, 1e-7) for p in exact])
    # A kink of ReLU within the differences' reach is possible, but not among these points.
    np.testing.assert_allclose(gradient.numpy(), expected, atol=2e-5 * max(1.0, float(np.abs(expected).max())))
    torch.testing.assert_close(field.signed_distance(torch.from_numpy(points)), distance, rtol=0, atol=1e-6)
    write_safe_field(tmp_path / "field", description(**values), stored)
    read = open_field(tmp_path / "field")
    assert isinstance(read, SdfField)
    many = torch.randn(10_000, 3, generator=torch.Generator().manual_seed(0))
    assert torch.equal(read.to("cpu").signed_distance(many), field.signed_distance(many))
    seen = many[:5].clone().requires_grad_(True)
    differentiable_signed_distance(read, seen).sum().backward()  # type: ignore[no-untyped-call]
    assert seen.grad is not None
    torch.testing.assert_close(seen.grad, field.signed_distance_and_gradient(many[:5])[1])


WHOLE = tensors(CASES["normalized"])
FAULTY = [
    *(
        ({}, {key: WHOLE[key] for key in WHOLE if key != name})
        for name in ("norms.1.bias", "layers.2.bias", "layers.2.weight")
    ),
    *(({}, WHOLE | {name: WHOLE[name][:-1]}) for name in ("norms.1.bias", "layers.2.weight", "layers.3.bias")),
    *(({"input_at": layers}, WHOLE) for layers in ([], [0, 2], [2, 5])),
    *(({"normalized": layers}, WHOLE) for layers in ([0, 1, 4], [0, 1])),
    *(({"positional_encoding": {"degree": 1}}, WHOLE), ({}, {})),
]


@pytest.mark.parametrize(("changes", "stored"), FAULTY)
def test_tensors_that_do_not_fit(changes: dict[str, Any], stored: dict[str, Array], tmp_path: Path) -> None:
    described = description(**CASES["normalized"] | changes)
    assert_refused(lambda: write_safe_field(tmp_path / "f", described, stored), "FIELD_SHAPES_MISMATCH")


@pytest.mark.parametrize(
    "changes",
    [
        *({"activation": "swish"}, {"activation": "leaky_relu", "negative_slope": 2.0}, {"output_tanh": 3}),
        *({"input_at": [-1]}, {"input_at": list(range(40))}, {"hash": None}),
    ],
)
def test_descriptions_that_mean_nothing(changes: dict[str, Any]) -> None:
    assert_refused(lambda: parse_description(description(**PLAIN | changes)), "SAFE_FORMAT_INVALID")
