"""The index of occupied cells: against a search through all of them."""

from __future__ import annotations

import pytest
import torch

from regnf_core.errors import FieldFormatError
from regnf_core.fields import voxel_blocks
from regnf_core.fields.voxel_blocks import CellIndex


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


@pytest.mark.parametrize(
    "cells",
    [
        torch.zeros(0, 3),
        torch.tensor([[1, 2, 3], [1, 2, 3]]),
        torch.tensor([[1 << 20, 0, 0]]),
        torch.tensor([[-(1 << 63), 0, 0]]),
    ],
)
def test_faulty_cells_are_refused(cells: torch.Tensor) -> None:
    with pytest.raises(FieldFormatError) as caught:
        CellIndex.of(cells)
    assert caught.value.reason == "FIELD_INDEX_INVALID"
