"""Times one field's evaluation in this process, and prints the figures as JSON: see the table `evaluator`.

python -m benchmarks.robust.evaluator_process FIELD.safetensors
"""

from __future__ import annotations

import json
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from benchmarks.robust.plain_field import PlainField
from regnf_core import open_field

POINTS, RUNS, LARGE = 5000, 24, 1536


def seconds(task: Callable[[], Any]) -> float:
    """How long the task takes, once."""
    begun = time.perf_counter()
    task()
    return time.perf_counter() - begun


def side_by_side(path: Path) -> dict[str, float]:
    """Medians of alternating runs of both evaluators, and how far their results lie apart."""
    field, plain = open_field(path), PlainField(path)
    low, high = field.bounds
    unit = torch.rand(POINTS, 3, generator=torch.Generator().manual_seed(0))
    points = low.float() + unit * (high - low).float()
    ours, theirs = field.signed_distance_and_gradient(points), plain.value_and_gradient(points)
    times = [
        (seconds(lambda: field.signed_distance_and_gradient(points)), seconds(lambda: plain.value_and_gradient(points)))
        for _ in range(RUNS)
    ]
    return {
        "ours": statistics.median(one[0] for one in times),
        "plain": statistics.median(one[1] for one in times),
        "ratio": statistics.median(one[1] / one[0] for one in times),
        "value_difference": float((ours[0] - theirs[0]).abs().max()),
        "gradient_difference": float((ours[1] - theirs[1]).abs().quantile(0.99)),
    }


def machine_limits(path: Path) -> dict[str, float]:
    """FLOP and gathers of one evaluation, and the rates at which this machine does such things at best."""
    plain = PlainField(path)
    shapes = plain.shapes()
    shapes[-1] = (shapes[-1][0], 1)  # of the last layer only the distance is needed
    flop = 4.0 * sum(a * b for a, b in shapes)  # forward, and the same backward; 2 FLOP for a product and its sum
    rows = 8 * len(plain.tables)
    table = torch.cat(plain.tables).view(torch.complex64).view(-1)
    index = torch.randint(len(table), (rows * POINTS,), generator=torch.Generator().manual_seed(1))
    wide = [(torch.rand(4096, a), torch.rand(a, b)) for a, b in shapes[:-1]]
    big = torch.rand(LARGE, LARGE)
    gather = min(seconds(lambda: table.index_select(0, index)) for _ in range(8))
    same = min(seconds(lambda: [a @ b for a, b in wide]) for _ in range(20))
    large = min(seconds(lambda: big @ big) for _ in range(8))
    return {
        "flop_per_point": flop,
        "gathered_bytes_per_point": 8.0 * rows,
        "table_megabytes": table.numel() * 8 / 1e6,
        "gather_bytes_per_second": 8.0 * len(index) / gather,
        "same_shape_flops": 4096 * 2.0 * sum(a * b for a, b in shapes[:-1]) / same,
        "large_flops": 2.0 * LARGE**3 / large,
    }


def main() -> None:
    path = Path(sys.argv[1])
    print(json.dumps({"threads": torch.get_num_threads(), **side_by_side(path), **machine_limits(path)}))


if __name__ == "__main__":
    main()
