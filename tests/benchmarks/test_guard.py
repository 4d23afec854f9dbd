"""The guard's report and its figures."""

from __future__ import annotations

from pathlib import Path

import torch

from benchmarks.guard.__main__ import report
from benchmarks.guard.fields import DEMO, ROOM, write_grid
from benchmarks.guard.measure import STAGES, processor_seconds, stages
from regnf_core import open_field


def test_reports_medians_and_the_range_of_the_ratios() -> None:
    none = dict.fromkeys(STAGES, 0.0)
    rounds = [
        (
            {"import": {"seconds": 2.0}, "case": {"seconds": b, **none, "search": 0.2}},
            {"import": {"seconds": 1.0}, "case": {"seconds": a, **none, "search": 0.1}},
        )
        for b, a in ((1.0, 0.5), (1.0, 0.8), (2.0, 1.0))
    ]
    text = report(rounds, "# Heading")
    assert "| case | 1.0000 | 0.8000 | 0.50 | 0.50 to 0.80 |" in text
    assert "| import | 2.0000 | 1.0000 | 0.50 | 0.50 to 0.50 |" in text
    assert "200 / 100" in text


def test_times_each_run_and_finds_the_stages() -> None:
    def search_poses(number: int) -> int:
        return sum(range(20_000 + number))

    assert len(processor_seconds(search_poses, 3)) == 3
    found = stages(search_poses, 2)
    assert found["search"] > 0.0
    assert found["covariance"] == 0.0


def test_the_grid_is_the_room(tmp_path: Path) -> None:
    target = tmp_path / "grid.safetensors"
    write_grid(DEMO / f"{ROOM}.safetensors", target, nodes=12)
    field, grid = open_field(DEMO / f"{ROOM}.safetensors"), open_field(target)
    torch.testing.assert_close(grid.bounds, field.bounds)
    low, high = (corner.float() for corner in field.bounds)
    nodes = low + torch.tensor([[0.0, 0.0, 0.0], [4.0, 7.0, 2.0]]) / 11.0 * (high - low)
    torch.testing.assert_close(grid.signed_distance(nodes), field.signed_distance(nodes), rtol=0, atol=1e-5)
