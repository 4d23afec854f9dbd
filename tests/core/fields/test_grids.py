"""Kinds of grids."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from regnf_core.fields import voxel_blocks
from regnf_core.fields.build import build_field, open_field
from regnf_core.fields.observation import SdfField, has_color
from regnf_core.fields.voxel_blocks import CellIndex
from regnf_core.schema.safe_format import parse_description, write_safe_field
from tests.core.fields.grids import slow_trilinear
from tests.core.fields.reference import central_differences
from tests.core.importing.archives import assert_refused

# The index of occupied cells: against a search through all of them.


def some_cells(count: int, reach: int) -> torch.Tensor:
    """Distinct cells (count, 3), in no order."""
    drawn = torch.randint(-reach, reach, (4 * count, 3), generator=torch.Generator().manual_seed(1))
    return torch.unique(drawn, dim=0)[torch.randperm(count, generator=torch.Generator().manual_seed(2))]


def test_every_cell_is_found_and_no_other() -> None:
    cells = some_cells(60, 8)
    asked = torch.cartesian_prod(*[torch.arange(-10, 11)] * 3)
    row, found = CellIndex.of(cells).find(asked)
    same = (asked[:, None] == cells[None]).all(-1)  # (M, N)
    assert found.equal(same.any(-1))
    assert row[found].equal(same.long().argmax(-1)[found])


@pytest.mark.parametrize("most", [1 << 18, 200])
def test_the_nearest_cells_are_near(monkeypatch: pytest.MonkeyPatch, most: int) -> None:
    """With a table of single cells exactly so; with a coarser one to the cells of the table."""
    monkeypatch.setattr(voxel_blocks, "_TABLE_CELLS", most)
    cells = some_cells(60, 8)
    index = CellIndex.of(cells)
    assert (index.step == 1) == (most > 16**3)
    asked = torch.cartesian_prod(*[torch.arange(-8, 8)] * 3)
    asked = asked[((asked >= cells.amin(0)) & (asked <= cells.amax(0))).all(-1)]
    distance = torch.cdist(asked.float(), cells.float())
    nearest = distance.sort(dim=-1).values[:, :4]
    found = distance.gather(1, index.nearest(asked))
    slack = 3**0.5 * (index.step - 1)
    assert (found <= nearest + slack + 1e-5).all()
    assert index.nearest(torch.tensor([[1000, -1000, 3]])).shape == (1, 4)


def test_few_cells_far_apart_take_little_memory() -> None:
    cells = torch.tensor([[-1_000_000, 0, 0], [0, 1_000_000, 0], [3, 4, 1_000_000]])
    index = CellIndex.of(cells)
    assert index.table.numel() <= 3 << 18
    row, found = index.find(cells)
    assert found.all()
    assert row.tolist() == [0, 1, 2]
    moved = index.to("cpu")
    assert moved.find(cells[1:])[0].tolist() == [1, 2]


def test_faulty_cells_are_refused() -> None:
    for cells in ([], [[1, 2, 3], [1, 2, 3]], [[1 << 20, 0, 0]], [[-(1 << 63), 0, 0]]):
        stored = torch.tensor(cells, dtype=torch.int64).reshape(-1, 3)
        assert_refused(lambda stored=stored: CellIndex.of(stored), "FIELD_INDEX_INVALID")


# The kind ``voxel_grid``: against slow interpolation, on the grid's borders, and far outside.

ORIGIN, SPACING = np.array([-0.4, 0.2, 1.0]), np.array([0.1, 0.25, 0.05])
VALUES = np.random.default_rng(5).normal(size=(5, 4, 6)).astype(np.float32)
FAR = ORIGIN + SPACING * (np.array(VALUES.shape) - 1)


def description(**changes: Any) -> dict[str, Any]:
    values = {"kind": "voxel_grid", "origin": ORIGIN.tolist(), "spacing": SPACING.tolist()}
    return values | {"bounds": [ORIGIN.tolist(), FAR.tolist()]} | changes


def field(values: NDArray[Any] = VALUES, **changes: Any) -> SdfField:
    return build_field(parse_description(description(**changes)), {"values": torch.from_numpy(values)})


def slow(point: NDArray[np.float64], sign: float = 1.0) -> float:
    """The grid's value at a point, extended: the nearest point of the box, plus the way there."""
    inside = np.clip(point, ORIGIN, FAR)
    position = np.clip((inside - ORIGIN) / SPACING, 0.0, np.array(VALUES.shape) - 1.000000001)
    within = slow_trilinear(lambda node: float(VALUES[node]), position)
    return within + sign * float(np.linalg.norm(point - inside))


def points(count: int, reach: float) -> NDArray[np.float64]:
    """Points in the grid's box grown by ``reach`` on all sides, off the cells' borders."""
    rng = np.random.default_rng(2)
    drawn = ORIGIN - reach + rng.random((count, 3)) * (FAR - ORIGIN + 2 * reach)
    return drawn[(np.abs((drawn - ORIGIN) / SPACING % 1.0 - 0.5) < 0.49).all(axis=1)]


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("reach", [0.0, 0.7])
def test_values_and_gradients_are_those_of_slow_interpolation(reach: float, sign: int) -> None:
    where = points(150, reach)
    value, gradient = field(sign=sign).signed_distance_and_gradient(torch.from_numpy(where))
    expected = [sign * slow(point, sign) for point in where]
    slopes = [sign * central_differences(lambda p: slow(p, sign), point) for point in where]
    np.testing.assert_allclose(value.numpy(), expected, rtol=0, atol=2e-5)
    np.testing.assert_allclose(gradient.numpy(), slopes, rtol=0, atol=2e-3)


def test_nodes_have_their_own_values_the_last_ones_too() -> None:
    nodes = np.stack(np.meshgrid(*map(np.arange, VALUES.shape), indexing="ij"), axis=-1).reshape(-1, 3)
    value = field().signed_distance(torch.from_numpy(ORIGIN + SPACING * nodes))
    np.testing.assert_allclose(value.numpy(), VALUES.reshape(-1), rtol=0, atol=1e-5)


def test_there_is_no_jump_at_the_box_and_none_beyond() -> None:
    ray = np.linspace(FAR - 0.01, FAR + np.array([0.5, 0.1, 0.3]), 4000)
    value = field().signed_distance(torch.from_numpy(ray)).numpy()
    step = float(np.linalg.norm(ray[1] - ray[0]))
    steepest = np.abs(np.diff(VALUES, axis=0)).max() / SPACING.min() * 3
    assert np.abs(np.diff(value)).max() < step * (steepest + 1.0)
    assert np.isfinite(field().signed_distance(torch.tensor([[1e8, -1e8, 1e8]])).numpy()).all()


def test_colors_are_interpolated_between_the_nodes_that_have_one() -> None:
    rng = np.random.default_rng(8)
    colors = rng.random((*VALUES.shape, 3)).astype(np.float32)
    colors[rng.random(VALUES.shape) < 0.3] = -1.0
    tensors = {"values": torch.from_numpy(VALUES), "color.values": torch.from_numpy(colors)}
    made = build_field(parse_description(description(color={"form": "values"})), tensors)
    assert has_color(made)
    where = np.concatenate([points(80, 0.0), points(40, 0.5)])
    found = made.color(torch.from_numpy(where).float(), torch.zeros(len(where), 3)).numpy()
    for point, color in zip(where, found, strict=True):
        position = np.clip((np.clip(point, ORIGIN, FAR) - ORIGIN) / SPACING, 0.0, np.array(VALUES.shape) - 1.000000001)
        known = slow_trilinear(lambda node: float(colors[node][0] >= 0.0), position)
        total = [slow_trilinear(lambda n, k=k: max(float(colors[n][k]), 0.0), position) for k in range(3)]
        np.testing.assert_allclose(color, np.array(total) / known if known > 1e-6 else 0.0, atol=2e-5)
    assert not has_color(field())


def test_half_precision_stays_half_and_is_evaluated_in_single(tmp_path: Path) -> None:
    half = VALUES.astype(np.float16)
    write_safe_field(tmp_path / "f", description(), {"values": half})
    where = torch.from_numpy(points(50, 0.2))
    opened = open_field(tmp_path / "f")
    # One by tensor algebra, one by compiled code: they round differently.
    torch.testing.assert_close(opened.signed_distance(where), field(half.astype(np.float32)).signed_distance(where))
    torch.testing.assert_close(opened.to("cpu").signed_distance(where), opened.signed_distance(where))


def test_world_scale_moves_the_grid_along() -> None:
    where = torch.from_numpy(points(50, 0.3))
    bounds = [(2.0 * ORIGIN).tolist(), (2.0 * FAR).tolist()]
    scaled = field(world_scale=2.0, bounds=bounds).signed_distance(2.0 * where)
    torch.testing.assert_close(scaled, 2.0 * field().signed_distance(where))


def test_other_shapes_types_and_placements_are_refused(tmp_path: Path) -> None:
    for shape, kind in (((4, 4), np.float32), ((1, 4, 4), np.float32), ((4, 4, 4), np.int32)):
        tensors = {"values": np.zeros(shape, kind)}
        assert_refused(
            lambda tensors=tensors: write_safe_field(tmp_path / "f", description(), tensors), "FIELD_SHAPES_MISMATCH"
        )
    colored = {"values": VALUES, "color.values": np.zeros((*VALUES.shape[:2], 3), np.float32)}
    described = description(color={"form": "values"})
    assert_refused(lambda: write_safe_field(tmp_path / "f", described, colored), "FIELD_SHAPES_MISMATCH")
    for name, value in (("spacing", [0.1, 0.0, 0.1]), ("spacing", [0.1, -0.1, 0.1]), ("origin", [0.0, np.nan, 0.0])):
        faulty = description(**{name: value})
        assert_refused(lambda faulty=faulty: parse_description(faulty), "SAFE_FORMAT_INVALID")
