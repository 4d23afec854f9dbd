"""The kind ``voxel_blocks``: against slow interpolation within blocks, between them and where there are none."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from regnf_core.fields.build import build_field, open_field
from regnf_core.fields.observation import ColoredField, SdfField, has_color
from regnf_core.schema.safe_format import parse_description, write_safe_field
from tests.core.fields.grids import slow_trilinear
from tests.core.fields.reference import central_differences
from tests.core.importing.archives import assert_refused

EDGE, SIZE = 4, 0.1
ORIGIN = np.array([0.05, 0.0, -0.02])
BLOCKS = np.array([[0, 0, 0], [1, 0, 0], [-2, 1, 0], [0, -1, -1]], dtype=np.int32)
VALUES = np.random.default_rng(4).normal(size=(4, EDGE, EDGE, EDGE)).astype(np.float32)


def description(**changes: Any) -> dict[str, Any]:
    bounds = [[-1.0] * 3, [1.0] * 3]
    return {"kind": "voxel_blocks", "origin": ORIGIN.tolist(), "voxel_size": SIZE, "bounds": bounds} | changes


def field(values: NDArray[Any] = VALUES, blocks: NDArray[Any] = BLOCKS, **changes: Any) -> SdfField:
    tensors = {"values": torch.from_numpy(values), "blocks": torch.from_numpy(blocks)}
    return build_field(parse_description(description(**changes)), tensors)


def slow_node(node: tuple[int, int, int], sign: int = 1) -> float:
    """A node's value: its block's, or the least that any block allows."""
    allowed = []
    for block, values in zip(BLOCKS, VALUES, strict=True):
        local = np.array(node) - EDGE * block
        inside = np.clip(local, 0, EDGE - 1)
        if (local == inside).all():
            return float(values[tuple(inside)])
        allowed.append(sign * float(values[tuple(inside)]) + SIZE * float(np.linalg.norm(local - inside)))
    return sign * min(allowed)


def slow(point: NDArray[np.float64], sign: int = 1) -> float:
    return slow_trilinear(lambda node: slow_node(node, sign), (point - ORIGIN) / SIZE)


@pytest.mark.parametrize("sign", [1, -1])
def test_values_and_gradients_are_those_of_slow_interpolation(sign: int) -> None:
    drawn = np.random.default_rng(6).uniform(-1.2, 1.2, (70, 3))
    where = drawn[(np.abs((drawn - ORIGIN) / SIZE % 1.0 - 0.5) < 0.49).all(axis=1)]
    value, gradient = field(sign=sign).signed_distance_and_gradient(torch.from_numpy(where))
    expected = [sign * slow(point, sign) for point in where]
    slopes = [sign * central_differences(lambda p: slow(p, sign), point) for point in where]
    np.testing.assert_allclose(value.numpy(), expected, rtol=0, atol=1e-5)
    np.testing.assert_allclose(gradient.numpy(), slopes, rtol=0, atol=1e-3)


def ball(radius: float) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Distances to a ball's surface in the blocks that it passes through, and those blocks."""
    cells = np.stack(np.meshgrid(*[np.arange(-5, 5)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    local = np.stack(np.meshgrid(*[np.arange(EDGE)] * 3, indexing="ij"), axis=-1)
    distance = np.linalg.norm(SIZE * (EDGE * cells[:, None, None, None] + local), axis=-1) - radius
    touched = (np.abs(distance) < SIZE).any(axis=(1, 2, 3))
    return distance[touched].astype(np.float32), cells[touched].astype(np.int32)


def test_round_about_a_surface_the_slope_stays_that_of_a_distance() -> None:
    """Most of this space is in no block. Outside matter there is no step from block to block, and none beyond them."""
    values, blocks = ball(1.3)
    made = field(values, blocks, origin=[0.0] * 3)
    points = torch.rand(20_000, 3, generator=torch.Generator().manual_seed(0)) * 4 - 2
    distance, gradient = made.signed_distance_and_gradient(points)
    norm = gradient.norm(dim=-1)
    true = points.norm(dim=-1) - 1.3
    outside = true > 0
    assert float((norm[outside] > 2.0).float().mean()) < 1e-3
    assert float((norm > 2.0).float().mean()) < 1e-2
    assert float((norm - 1).abs().median()) < 0.05
    assert float((distance - true).abs()[true.abs() < 0.05].max()) < 0.02
    assert (distance[outside] > true[outside] - 0.03).all()
    assert (distance[outside] < 1.6 * true[outside] + 0.03).all()


def test_far_away_it_is_finite() -> None:
    points = torch.tensor([[1e7, 0.0, 0.0], [-1e7, 1e7, -1e7]])
    distance = field().signed_distance(points)
    torch.testing.assert_close(distance, points.norm(dim=-1), rtol=1e-4, atol=0)


def test_the_file_and_another_device_change_nothing(tmp_path: Path) -> None:
    write_safe_field(tmp_path / "f", description(), {"values": VALUES.astype(np.float16), "blocks": BLOCKS})
    opened = open_field(tmp_path / "f")
    points = torch.rand(100, 3, generator=torch.Generator().manual_seed(3)) - 0.5
    expected = field(VALUES.astype(np.float16).astype(np.float32)).signed_distance(points)
    torch.testing.assert_close(opened.signed_distance(points), expected, rtol=0, atol=0)
    torch.testing.assert_close(opened.to("cpu").signed_distance(points), expected, rtol=0, atol=0)


def test_faulty_tensors_are_refused(tmp_path: Path) -> None:
    def write_and_open(values: Any = VALUES, blocks: Any = BLOCKS) -> None:
        write_safe_field(tmp_path / "f", description(), {"values": values, "blocks": blocks})
        open_field(tmp_path / "f")

    for values in (VALUES[:3], VALUES[..., :2]):
        assert_refused(lambda values=values: write_and_open(values), "FIELD_SHAPES_MISMATCH")
    for blocks in (BLOCKS[:, :2], BLOCKS.astype(np.float32)):
        assert_refused(lambda blocks=blocks: write_and_open(blocks=blocks), "FIELD_SHAPES_MISMATCH")
    assert_refused(lambda: write_and_open(blocks=np.zeros_like(BLOCKS)), "FIELD_INDEX_INVALID")
    colored = {"values": VALUES, "blocks": BLOCKS, "color.values": VALUES.astype(np.float16)}
    described = description(color={"form": "values"})
    assert_refused(lambda: write_safe_field(tmp_path / "f", described, colored), "FIELD_SHAPES_MISMATCH")


def slow_color(node: tuple[int, int, int], colors: NDArray[Any]) -> NDArray[Any]:
    """A node's color: its block's, or that of the nearest node of any block."""
    away = []
    for block in BLOCKS:
        local = np.array(node) - EDGE * block
        away.append(float(np.linalg.norm(local - np.clip(local, 0, EDGE - 1))))
    nearest = int(np.argmin(away))
    inside = np.clip(np.array(node) - EDGE * BLOCKS[nearest], 0, EDGE - 1)
    found: NDArray[Any] = colors[nearest][tuple(inside)]
    return found


def colored(colors: NDArray[Any]) -> ColoredField:
    tensors = {"values": VALUES, "blocks": BLOCKS, "color.values": colors}
    parsed = parse_description(description(color={"form": "values"}))
    made = build_field(parsed, {name: torch.from_numpy(array) for name, array in tensors.items()})
    assert has_color(made)
    return made


def test_colors_are_interpolated() -> None:
    rng = np.random.default_rng(5)
    colors = rng.random((*VALUES.shape, 3)).astype(np.float32)
    cells = EDGE * BLOCKS[rng.integers(0, 4, 60)] + rng.integers(0, EDGE - 1, (60, 3))
    points = ORIGIN + SIZE * (cells + rng.random((60, 3)))
    found = colored(colors).color(torch.from_numpy(points), torch.zeros(60, 3)).numpy()
    for point, color in zip(points, found, strict=True):
        expected = [
            slow_trilinear(lambda node, c=c: slow_color(node, colors)[c], (point - ORIGIN) / SIZE) for c in range(3)
        ]
        np.testing.assert_allclose(color, expected, rtol=0, atol=1e-5)


def test_nodes_without_color_do_not_count() -> None:
    colors = np.full((*VALUES.shape, 3), -1.0, np.float32)
    colors[:, 0] = [0.25, 0.5, 0.75]
    point = ORIGIN + SIZE * np.array([0.9, 1.5, 1.5])  # between the first nodes along x and the second
    found = colored(colors).color(torch.from_numpy(point)[None], torch.zeros(1, 3)).numpy()
    np.testing.assert_allclose(found, [[0.25, 0.5, 0.75]], rtol=0, atol=1e-6)
