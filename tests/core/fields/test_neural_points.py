"""The kind ``neural_points``: against a slow evaluation in float64, one place and one cell after the other."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from regnf_core.fields.build import build_field, open_field
from regnf_core.fields.observation import SdfField
from regnf_core.schema.safe_format import parse_description, write_safe_field
from tests.core.fields.reference import central_differences
from tests.core.importing.archives import assert_refused

Array = NDArray[Any]
CELL, REACH, MOST = 0.3, 2.5, 0.9
PRIMES = (73856093, 19349669, 83492791)


def description(**changes: Any) -> dict[str, Any]:
    values = {
        "kind": "neural_points",
        "bounds": [[-1.5] * 3, [1.5] * 3],
        "cell_size": CELL,
        "buffer_size": 50_000_000,
        "reach": REACH,
        "max_distance": MOST,
        "neighbors": 6,
        "blend_first": True,
        "oriented": False,
    }
    return values | changes


def tensors(oriented: bool = False) -> dict[str, Array]:
    """Points in part of a cube, some of them in one cell, and a network of two layers."""
    rng = np.random.default_rng(11)
    points = rng.uniform(-1.0, 0.6, (150, 3))
    made = {"points": points, "features": rng.normal(size=(150, 5))}
    if oriented:
        made["orientations"] = rng.normal(size=(150, 4))
    for i, shape in enumerate(((16, 8), (3, 16))):
        made[f"layers.{i}.weight"] = rng.normal(size=shape) / math.sqrt(shape[1])
        made[f"layers.{i}.bias"] = 0.1 * rng.normal(size=shape[0])
    return {name: array.astype(np.float32) for name, array in made.items()}


def field(values: dict[str, Any], parameters: dict[str, Array]) -> SdfField:
    return build_field(parse_description(values), {name: torch.from_numpy(a) for name, a in parameters.items()})


def rotated_back(quaternion: Array, vector: Array) -> Array:
    """The vector in the frame that the quaternion (w, x, y, z) turned: v + 2 w (u x v) + 2 u x (u x v), u = -xyz."""
    w, *xyz = quaternion / np.linalg.norm(quaternion)
    u = -np.array(xyz)
    turned: Array = vector + 2 * w * np.cross(u, vector) + 2 * np.cross(u, np.cross(u, vector))
    return turned


class Slow:
    """The field by the published formulas."""

    def __init__(self, values: dict[str, Any], parameters: dict[str, Array]) -> None:
        self.values = values
        self.p = {name: array.astype(np.float64) for name, array in parameters.items()}
        self.buffer: dict[int, int] = {}
        for row, point in enumerate(parameters["points"]):
            self.buffer[self.number(np.floor(point / np.float32(CELL)))] = row

    def number(self, cell: Array) -> int:
        return sum(int(c) * prime for c, prime in zip(cell, PRIMES, strict=True)) % int(self.values["buffer_size"])

    def nearest(self, place: Array) -> list[tuple[float, int]]:
        found = []
        own = np.floor(place.astype(np.float32) / np.float32(CELL))
        for offset in itertools.product(range(-3, 4), repeat=3):
            row = self.buffer.get(self.number(own + np.array(offset)))
            if row is None or sum(o * o for o in offset) >= REACH**2:
                continue
            distance = float(np.linalg.norm(place - self.p["points"][row]))
            if distance <= MOST:
                found.append((distance, row))
        return sorted(found)[: self.values["neighbors"]]

    def decode(self, features: Array) -> float:
        hidden = np.maximum(self.p["layers.0.weight"] @ features + self.p["layers.0.bias"], 0.0)
        return float(self.p["layers.1.weight"][0] @ hidden + self.p["layers.1.bias"][0])

    def __call__(self, place: Array) -> float:
        near = self.nearest(place)
        if not near:
            return min(float(np.linalg.norm(place - self.p["points"][row])) for row in self.buffer.values())
        shares = np.array([1.0 / (distance**2 + 1e-15) for distance, _ in near])
        shares /= shares.sum()
        inputs = []
        for _, row in near:
            relative = place - self.p["points"][row]
            if self.values["oriented"]:
                relative = rotated_back(self.p["orientations"][row], relative)
            inputs.append(np.concatenate((self.p["features"][row], relative)))
        if self.values["blend_first"]:
            return self.decode(sum(share * one for share, one in zip(shares, inputs, strict=True)))
        return float(sum(share * self.decode(one) for share, one in zip(shares, inputs, strict=True)))


CASES: dict[str, dict[str, Any]] = {
    "blended first": {"buffer_size": 97},  # too small: points share a place in it
    "decoded first": {"blend_first": False, "neighbors": 2},
    "turned": {"oriented": True},
    "turned, decoded first": {"oriented": True, "blend_first": False},
}


@pytest.mark.parametrize("case", CASES)
def test_values_and_gradients_are_those_of_a_slow_evaluation(case: str) -> None:
    values = description(**CASES[case])
    parameters = tensors(values["oriented"])
    slow = Slow(values, parameters)
    places = np.random.default_rng(1).uniform(-1.3, 1.0, (25, 3))
    distance, gradient = field(values, parameters).signed_distance_and_gradient(torch.from_numpy(places))
    known = np.array([bool(slow.nearest(place)) for place in places])
    assert known.sum() > 15
    expected = np.array([slow(place) for place in places])
    slopes = np.array([central_differences(slow, place) for place in places])
    np.testing.assert_allclose(distance.numpy()[known], expected[known], rtol=0, atol=2e-5)
    # A kink of the network, or a change of neighbors, may lie between the two ends of a difference.
    wrong = np.abs(gradient.numpy() - slopes).max(axis=1)[known] > 2e-3
    assert wrong.mean() < 0.05
    on_points = torch.from_numpy(parameters["points"])
    assert all(torch.isfinite(one).all() for one in field(values, parameters).signed_distance_and_gradient(on_points))


def test_out_of_reach_the_distance_to_a_point_stands_in(tmp_path: Path) -> None:
    parameters = tensors()
    made = field(description(), parameters)
    places = torch.tensor([[3.0, 3.0, 3.0], [-9.0, 0.0, 0.0], [1e6, -1e6, 1e6]])
    distance, gradient = made.signed_distance_and_gradient(places)
    nearest = torch.cdist(places, torch.from_numpy(parameters["points"])).min(dim=-1).values
    assert (distance >= nearest - 1e-3 * nearest).all()
    assert (distance <= nearest + 2 * CELL + 1e-3 * nearest).all()
    torch.testing.assert_close(gradient.norm(dim=-1), torch.ones(3), rtol=0, atol=1e-4)
    write_safe_field(tmp_path / "f", description(), parameters)
    torch.testing.assert_close(open_field(tmp_path / "f").to("cpu").signed_distance(places), distance)


@pytest.mark.parametrize(
    "change",
    [
        {"features": np.zeros((149, 5), np.float32)},
        {"points": np.zeros((150, 2), np.float32)},
        {"layers.0.weight": np.zeros((16, 9), np.float32)},
        {"layers.1.bias": np.zeros(2, np.float32)},
        {"orientations": np.zeros((150, 4), np.float32)},
    ],
)
def test_tensors_that_do_not_fit_are_refused(tmp_path: Path, change: dict[str, Array]) -> None:
    assert_refused(lambda: write_safe_field(tmp_path / "f", description(), tensors() | change), "FIELD_SHAPES_MISMATCH")
