"""What a checkpoint of Neuralangelo without settings may stand for."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from regnf_core.importing.families.converted import Reading
from regnf_core.importing.gate.reading import Companions, read_upload
from regnf_core.importing.gate.report import ImportLimits
from tests.core.importing import small_families as small


def readings(folder: Path, iteration: int, said: dict[str, object] | None = None) -> tuple[Reading, ...]:
    path = folder / "checkpoint.pt"
    torch.save(small.neuralangelo(iteration).checkpoint, path)
    return read_upload(path, folder, said, ImportLimits(), Companions()).field.readings


@pytest.mark.parametrize("iteration", [20_000, 500_000])
def test_levels_are_opened_of_as_many_as_each_reading_has(iteration: int, tmp_path: Path) -> None:
    found = readings(tmp_path, iteration)
    numbers = {reading.description["hash"]["levels"] for reading in found}
    assert len(numbers) > 1
    by_step = (iteration - 5000) // 5000
    for reading in found:
        levels = reading.description["hash"]["levels"]
        assert reading.description["level_mask"] in {min(max(first, by_step), levels) for first in (4, 8)}


def test_other_cubes_are_tried_where_nothing_is_said(tmp_path: Path) -> None:
    found = readings(tmp_path, 500_000)
    radii = {reading.description["grid_radius"] for reading in found}
    assert radii == {1.0, 1.5, 2.0}
    usual = min(found, key=lambda reading: reading.tier)
    assert usual.description["grid_radius"] == 2.0
    others = [reading for reading in found if reading.description["grid_radius"] != 2.0]
    assert all(reading.say["hash"]["radius"] == reading.description["grid_radius"] for reading in others)
    said = readings(tmp_path, 500_000, {"hash": {"levels": 10}})
    assert {reading.description["grid_radius"] for reading in said} <= {2.0}
