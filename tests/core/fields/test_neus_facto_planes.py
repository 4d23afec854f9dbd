"""The evaluator in planes against the plain function, which has its own tests against references and slow loops."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import pytest
import torch

from regnf_core.fields.hash_encoding import HashEncoding
from regnf_core.fields.neus_facto import NeusFactoField, NeusFactoPlanes, build_neus_facto, planes_of, prepared
from regnf_core.fields.neus_facto_function import NeusFactoFunction
from regnf_core.schema.description import FieldDescription
from regnf_core.schema.hash_grid_config import HashGridConfig
from regnf_core.schema.safe_format import parse_description
from tests.core.fields.small_field import GRID, description, tensors


def function(layers: int = 3, grid: HashGridConfig = GRID, **changes: Any) -> NeusFactoFunction:
    described: FieldDescription = parse_description(description(hash=asdict(grid), **changes))
    made = {name: torch.from_numpy(value) for name, value in tensors(layers, grid=grid).items()}
    return build_neus_facto(described, made).function  # type: ignore[arg-type]


def places(reach: float = 1.0, count: int = 300) -> torch.Tensor:
    """Points spread over a cube, and its corners."""
    spread = 2.0 * torch.rand(count, 3, generator=torch.Generator().manual_seed(5)) - 1.0
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3)
    return reach * torch.cat([spread, corners])


def assert_same(one: NeusFactoFunction, points: torch.Tensor) -> None:
    fast = prepared(one)
    assert isinstance(fast, NeusFactoPlanes)
    with torch.no_grad():
        value, gradient = one.value_and_gradient(points)
        found, slope = fast.value_and_gradient(points)
        torch.testing.assert_close(fast.value(points), value, rtol=1e-6, atol=2e-6)
    torch.testing.assert_close(found, value, rtol=1e-6, atol=2e-6)
    torch.testing.assert_close(slope, gradient, rtol=0, atol=4e-6 * float(gradient.abs().max()))


@pytest.mark.parametrize("features", [1, 2, 4, 8])
@pytest.mark.parametrize("interpolation", ["linear", "smoothstep"])
def test_agrees_with_the_plain_function(features: int, interpolation: Any) -> None:
    grid = replace(GRID, features_per_level=features, interpolation=interpolation)
    assert set(grid.level_is_dense()) == {True, False}
    assert_same(function(grid=grid), places())


@pytest.mark.parametrize("contraction", ["linf", "linf_grid"])
def test_agrees_under_a_contraction(contraction: str) -> None:
    assert_same(function(contraction=contraction), places(3.0))


def test_agrees_without_a_grid_with_a_mask_and_in_two_layers() -> None:
    assert_same(function(use_grid=False), places())
    assert_same(function(level_mask=2), places())
    assert_same(function(layers=2), places())


def test_agrees_at_the_border_of_the_cube_and_beyond() -> None:
    one = function()
    assert_same(one, places(one.grid_radius))
    assert_same(one, places(1.5 * one.grid_radius))


def test_agrees_where_no_point_is_within_the_cube() -> None:
    one = function()
    assert_same(one, 1.5 * one.grid_radius * torch.ones(1, 3))


def test_a_point_has_its_value_whatever_comes_with_it() -> None:
    one = function()
    field, points = NeusFactoField(one, torch.tensor([[-1.0] * 3, [1.0] * 3])), places(1.2 * one.grid_radius)
    together, alone = field.signed_distance(points), torch.cat([field.signed_distance(p[None]) for p in points[:40]])
    torch.testing.assert_close(alone, together[:40], rtol=0, atol=1e-6)


def test_the_gradient_is_that_of_the_value() -> None:
    fast, points, step = prepared(function()), places(), 1e-3
    with torch.no_grad():
        _, gradient = fast.value_and_gradient(points)
        along = [fast.value(points + step * axis) - fast.value(points - step * axis) for axis in torch.eye(3)]
    error = (torch.stack(along, 1) / (2 * step) - gradient).norm(dim=1) / gradient.norm(dim=1)
    assert float(error.median()) < 0.01  # a step that passes a cell's border sees two slopes


def test_follows_parameters_that_are_fitted() -> None:
    one = function()
    field, points = NeusFactoField(one, torch.tensor([[-1.0] * 3, [1.0] * 3])), places()
    before = field.signed_distance(points)
    assert one.hash_encoding is not None
    for tensor in (one.mlp.weights[0], one.hash_encoding.table):
        tensor.mul_(1.5)
        after = field.signed_distance(points)
        assert float((after - before).abs().max()) > 1e-3
        before = after
    assert_same(one, points)


def test_leaves_what_it_does_not_suit_to_the_plain_function() -> None:
    deep = function(layers=6)
    assert deep.mlp.skip_at is not None
    assert prepared(deep) is deep
    odd = replace(GRID, features_per_level=3)
    assert planes_of(HashEncoding(odd, torch.zeros(odd.entries, 3))) is None
