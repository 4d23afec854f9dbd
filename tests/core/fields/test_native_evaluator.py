"""The compiled evaluator: against the function in plain tensor algebra, and against double precision."""

from __future__ import annotations

import random
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch

from regnf_core.fields.color_head import PositionalEncoding
from regnf_core.fields.hash_encoding import HashEncoding
from regnf_core.fields.native_evaluator import NativeEvaluator, native_evaluator, suits
from regnf_core.fields.neus_facto import NeusFactoField
from regnf_core.fields.neus_facto_function import GeometryMlp, NeusFactoFunction
from regnf_core.schema.hash_grid_config import HashGridConfig
from tests.core.fields.native_builds import variants
from tests.core.fields.reference import central_differences, field_slowly
from tests.core.fields.small_field import GRID, tensors
from tests.core.fields.small_field import function as stored_function
from tests.core.fields.small_field import places as points_around

BOUNDS = torch.tensor([[-1.0] * 3, [1.0] * 3])
NAMES = ("avx512", "avx2", "plain")


@pytest.fixture(params=NAMES)
def compiled(request: pytest.FixtureRequest) -> Any:
    """Evaluates by the code for one set of instructions."""
    found = {one.name: one for one in variants()}
    if request.param not in found:
        pytest.skip(f"this processor does not run {request.param}")
    return lambda function: NativeEvaluator(function, found[request.param])


def random_function(seed: int) -> NeusFactoFunction:
    """Any form that the compiled code takes, with random parameters."""
    chosen, numbers = random.Random(seed), torch.Generator().manual_seed(seed)
    waves = grid = None
    width, radius = 3, chosen.choice([0.7, 1.0, 2.0])
    if chosen.random() < 0.75:
        waves = PositionalEncoding(chosen.randint(1, 6), chosen.choice([1.0, 6.2831855]), chosen.random() < 0.3)
        width += waves.width
    if chosen.random() < 0.85:
        grid = random_grid(chosen, numbers)
        width += grid.width
    widths = [width, *(chosen.choice([1, 3, 8, 13, 31, 64, 70]) for _ in range(chosen.randint(1, 3))), 1]
    weights = [torch.randn(b, a, generator=numbers) / a**0.5 for a, b in pairwise(widths)]
    biases = [0.1 * torch.randn(b, generator=numbers) for b in widths[1:]]
    contraction: Any = chosen.choice(["none", "linf", "linf_grid"])
    return NeusFactoFunction(GeometryMlp(weights, biases, None), waves, grid, contraction, radius)


def random_grid(chosen: random.Random, numbers: torch.Generator) -> HashEncoding:
    levels = chosen.randint(1, 8)
    config = HashGridConfig.from_top_resolution(
        chosen.choice([16, 64, 200]),
        levels=levels,
        features_per_level=chosen.choice([1, 2, 2, 3, 4, 8]),
        log2_table_size=chosen.choice([6, 10, 14]),
        base_resolution=chosen.choice([2, 4, 11]),
        interpolation=chosen.choice(["linear", "smoothstep"]),
    )
    table = torch.randn(config.entries, config.features_per_level, generator=numbers)
    return HashEncoding(config, table, chosen.choice([None, max(1, levels - 1)]))


def places(function: NeusFactoFunction, count: int = 203, seed: int = 3) -> torch.Tensor:
    """Points in the cube of the grid and, a quarter of them, around it; its corners, and one point a second time."""
    reach = 3.0 if function.contraction != "none" else function.grid_radius
    spread = 2.0 * torch.rand(count, 3, generator=torch.Generator().manual_seed(seed)) - 1.0
    spread[: count // 4] *= 1.3
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3)
    return reach * torch.cat([spread, corners, spread[-1:]])


@pytest.mark.parametrize("seed", range(0, 40, 2))
def test_agrees_with_the_plain_function(compiled: Any, seed: int) -> None:
    one = random_function(seed)
    assert suits(one)
    points, fast = places(one), compiled(one)
    with torch.no_grad():
        value, gradient = one.value_and_gradient(points)
    found, slope = fast.value_and_gradient(points)
    assert torch.equal(fast.value(points), found)
    # roundings of the value, and of the place in the cube, both in float32
    tolerance = 2e-6 * max(1.0, float(value.abs().max())) + 2.0**-22 * float(gradient.abs().max())
    torch.testing.assert_close(found, value, rtol=0, atol=tolerance)
    error = (slope - gradient).abs().amax(dim=1) / gradient.abs().max()
    # The slope of softplus changes by 25 a unit of its argument, so roundings of that count many times in the gradient.
    # A point within rounding of a cell's border has two slopes where the interpolation is linear.
    assert float(error.quantile(0.98)) < 3e-5
    smooth = one.hash_encoding is None or one.hash_encoding.config.interpolation == "smoothstep"
    assert float(error.max()) < 1e-4 or not smooth


@pytest.mark.parametrize(
    "changes", [{}, {"use_grid": False}, {"level_mask": 2}, {"contraction": "linf"}, {"layers": 2}]
)
def test_agrees_as_closely_as_the_planes_do(compiled: Any, changes: Any) -> None:
    one, points = stored_function(**changes), points_around(1.5)
    with torch.no_grad():
        value, gradient = one.value_and_gradient(points)
    found, slope = compiled(one).value_and_gradient(points)
    torch.testing.assert_close(found, value, rtol=1e-6, atol=2e-6)
    error = (slope - gradient).abs() / gradient.abs().max()
    assert float(error.quantile(0.99)) < 4e-6
    assert float(error.max()) < 8e-6


@pytest.mark.parametrize("contraction", ["none", "linf", "linf_grid"])
@pytest.mark.parametrize("two_pi", [False, True])
def test_agrees_with_double_precision(compiled: Any, contraction: Any, two_pi: bool) -> None:
    made = tensors()
    weights, biases = ([torch.from_numpy(made[f"layers.{i}.{part}"]) for i in range(3)] for part in ("weight", "bias"))
    one = NeusFactoFunction(
        GeometryMlp(weights, biases, None),
        PositionalEncoding(6, 2.0 * np.pi if two_pi else 1.0),
        HashEncoding(GRID, torch.from_numpy(made["hash_table"])),
        contraction,
    )
    points = (1.9 if contraction != "none" else 0.9) * places(one, 8)[:8] / 2.0
    value, gradient = compiled(one).value_and_gradient(points)
    for place, near, slope in zip(points.double().numpy(), value, gradient, strict=True):
        assert float(near) == pytest.approx(slowly(made, two_pi, contraction, place), abs=2e-5 if two_pi else 4e-6)
        expected = central_differences(lambda x: slowly(made, two_pi, contraction, x), place)
        assert np.abs(slope.numpy() - expected).max() < 1e-4 * (1 + np.abs(expected).max())


def slowly(made: Any, two_pi: bool, contraction: str, place: Any) -> float:
    return field_slowly(GRID, made, place, two_pi=two_pi, contraction=contraction)


@pytest.mark.parametrize("seed", [1, 2, 5])
def test_a_point_has_its_result_whatever_comes_with_it_and_wherever_it_lies(compiled: Any, seed: int) -> None:
    one = random_function(seed)
    fast, points = compiled(one), places(one, 140)
    value, gradient = fast.value_and_gradient(points)
    for count in (1, 7, 31, 32, 33, 64, 100):
        for start in (0, 5):
            part = slice(start, start + count)
            moved = torch.empty(3 * count + 1)[1:].view(count, 3).copy_(points[part])  # 4 bytes from where it was
            found, slope = fast.value_and_gradient(moved)
            assert torch.equal(found, value[part])
            assert torch.equal(slope, gradient[part])
    strided = torch.cat([points, points], dim=1)[:, :3]
    assert torch.equal(fast.value(strided), value)


@pytest.mark.parametrize("seed", range(0, 40, 10))
def test_what_is_no_place_has_no_distance(compiled: Any, seed: int) -> None:
    """NaN and infinity give what torch gives, and spoil no other point."""
    one = random_function(seed)
    fast, points = compiled(one), places(one, 40)
    value, gradient = fast.value_and_gradient(points)
    odd = points.clone()
    for row, number in enumerate((float("nan"), float("inf"), float("-inf"))):
        for axis in range(3):
            odd[3 * row + axis, axis] = number
    odd[9] = torch.full((1,), 0x7FC00001, dtype=torch.int32).view(torch.float32)  # NaN with a payload
    with torch.no_grad():
        expected, slopes = one.value_and_gradient(odd)
    found, slope = fast.value_and_gradient(odd)
    assert torch.equal(found.isnan(), expected.isnan())
    assert torch.equal(slope.isnan(), slopes.isnan())
    assert torch.equal(found[10:], value[10:])
    assert torch.equal(slope[10:], gradient[10:])


def test_far_points_read_nothing_beyond_the_table(compiled: Any) -> None:
    one = replace(random_function(3), contraction="none")
    grid = HashEncoding(GRID, torch.rand(GRID.entries, 2))
    one = NeusFactoFunction(
        GeometryMlp([torch.rand(4, 11), torch.rand(1, 4)], [torch.rand(4), torch.rand(1)], None), None, grid
    )
    far = torch.tensor([1e3, -1e5, 3e9, -3e9, 1e18, -1e19, 1e30])[:, None].expand(-1, 3)
    with torch.no_grad():
        expected = one.value(far)
    torch.testing.assert_close(compiled(one).value(far), expected, rtol=1e-3, atol=0)


def test_a_file_may_describe_any_scale(compiled: Any) -> None:
    """Levels with few nodes by their table and many cells by their scale; strides that wrap around 32 bits."""
    sizes: dict[str, Any] = {"resolutions": (4,) * 20, "strides": (1 << 16, 1 << 24) * 10, "log2_table_size": 8}
    config = HashGridConfig(levels=20, base_resolution=1024, per_level_scale=8.0, **sizes)
    grid = HashEncoding(config, torch.rand(config.entries, 2))
    mlp = GeometryMlp([torch.rand(4, 43), torch.rand(1, 4)], [torch.rand(4), torch.rand(1)], None)
    one = NeusFactoFunction(mlp, None, grid)
    corners = torch.cartesian_prod(*[torch.tensor([-2.0, 0.0, 1.0, 2.0])] * 3)  # exact at every scale
    with torch.no_grad():
        expected = one.value(corners)
    torch.testing.assert_close(compiled(one).value(corners), expected, rtol=1e-5, atol=0)


def test_large_angles_are_those_of_the_c_library(compiled: Any) -> None:
    """The network's own sums in double precision: what differs is the compiled evaluator's rounding."""
    waves, generator = PositionalEncoding(24, 6.2831855), torch.Generator().manual_seed(0)
    weights = [torch.rand(5, 3 + waves.width, generator=generator) - 0.5, torch.rand(1, 5, generator=generator)]
    biases = [torch.zeros(5), torch.zeros(1)]
    one = NeusFactoFunction(GeometryMlp(weights, biases, None), waves, None)
    exact = GeometryMlp([weight.double() for weight in weights], [bias.double() for bias in biases], None)
    points = 3.0 * torch.rand(50, 3, generator=generator)
    expected = exact(one.encode(points).double())
    torch.testing.assert_close(compiled(one).value(points).double(), expected, rtol=0, atol=3e-6)


def test_no_points(compiled: Any) -> None:
    value, gradient = compiled(random_function(0)).value_and_gradient(torch.empty(0, 3))
    assert (value.shape, gradient.shape) == ((0,), (0, 3))


INTERVALS = {
    "exp": (0, -87.0, 0.0),
    "log1p": (1, 0.0, 1.0),
    "sin": (2, -(2.0**20), 2.0**20),
    "cos": (3, -(2.0**20), 2.0**20),
}


@pytest.mark.parametrize("name", sorted(INTERVALS))
def test_elementary_functions_against_double_precision(name: str) -> None:
    """Relative error of exp and log1p, absolute of sin and cos: that of the polynomial and the roundings."""
    which, low, high = INTERVALS[name]
    x = torch.cat([torch.linspace(low, high, 300_001), torch.linspace(max(low, -8.0), min(high, 8.0), 300_001)])
    expected = getattr(torch, name)(x.double())
    for one in variants():
        found = torch.empty_like(x)
        one.elementary(which, x.data_ptr(), len(x), found.data_ptr())
        error = (found.double() - expected).abs()
        if name in ("exp", "log1p"):
            error = error[expected != 0] / expected[expected != 0].abs()
        assert float(error.max()) < (3e-7 if name == "exp" else 2e-7), one.name


def test_a_field_uses_it_where_it_is_there_and_on(monkeypatch: pytest.MonkeyPatch) -> None:
    (fastest, *_) = variants()
    one = random_function(1)
    field, points = NeusFactoField(one, BOUNDS), places(one)
    monkeypatch.setattr("regnf_core.fields.native_evaluator.variant", lambda: fastest)
    assert isinstance(native_evaluator(one), NativeEvaluator)
    value = field.signed_distance(points)
    monkeypatch.setattr("regnf_core.fields.native_evaluator.variant", lambda: None)
    assert native_evaluator(one) is None
    torch.testing.assert_close(field.signed_distance(points), value, rtol=0, atol=1e-5)


def test_it_follows_parameters_that_are_fitted(compiled: Any) -> None:
    one = random_function(1)
    points = places(one)
    before = compiled(one).value(points)
    one.mlp.weights[-1].mul_(1.5)
    after = compiled(one).value(points)
    assert float((after - before).abs().max()) > 1e-3
    torch.testing.assert_close(after, one.value(points), rtol=0, atol=1e-5)


def test_it_leaves_other_forms_and_wrong_shapes_alone() -> None:
    one = random_function(1)
    weights, biases = one.mlp.weights, one.mlp.biases
    assert suits(one)
    for mlp in (
        GeometryMlp(weights, biases, None, "relu"),
        GeometryMlp([weights[0][:, :-1].contiguous(), *weights[1:]], biases, None),
        GeometryMlp([weights[0].T.contiguous().T, *weights[1:]], biases, None),
        GeometryMlp([one.double() for one in weights], [one.double() for one in biases], None),
        GeometryMlp(weights, [biases[0][:-1], *biases[1:]], None),
    ):
        assert not suits(replace(one, mlp=mlp))
    assert one.hash_encoding is not None
    short = HashEncoding(one.hash_encoding.config, one.hash_encoding.table, one.hash_encoding.active_levels)
    short.table = short.table[:-9]
    assert not suits(replace(one, hash_encoding=short))
