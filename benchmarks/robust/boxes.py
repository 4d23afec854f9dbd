"""Table 4: detection boxes that are off center and of the wrong size, with the neighbors' matter in them."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import torch

from benchmarks.robust.cases import KINDS, Case, Pair, load_pairs
from benchmarks.robust.report import Table, accuracy_section, failures_of, of_kind, share_bar, successes
from benchmarks.robust.runs import Context, Job, run_all
from regnf_core import OrientedBox

NAME = "boxes"
SHIFT, STRETCH = 0.2, 0.3
"""Largest shift of the center and change of an edge, shares of the edge."""


def table(context: Context) -> Table:
    """Every pair with as many random boxes as there are seeds."""
    jobs = [
        Job(partial(noisy, pair, draw), f"{kind}: {pair.name}", draw)
        for kind, file in KINDS.items()
        for pair in load_pairs(context.folder, file)
        for draw in range(context.seeds)
    ]
    runs = run_all(jobs, context)
    main, held_out = of_kind(runs, "main"), of_kind(runs, "held out")
    return Table(
        NAME,
        "Noisy detection boxes",
        [
            share_bar("main pairs: at least 97 %", successes(main), len(main), 0.97),
            share_bar("held-out pairs: at least 97 %", successes(held_out), len(held_out), 0.97),
        ],
        [
            accuracy_section(
                "Along every axis the center is shifted by up to 20 % of the size and the size changed by up to 30 %, "
                "drawn evenly.",
                "pair",
                runs,
            )
        ],
        runs,
        failures_of(runs),
    )


def noisy(pair: Pair, draw: int) -> Case:
    """The pair with its box shifted and stretched at random; ``draw`` is the seed."""
    generator = torch.Generator().manual_seed(1000 + draw)
    shift, change = 2 * torch.rand(2, 3, generator=generator, dtype=torch.float64) - 1
    box = pair.detection
    center = box.center + box.rotation @ (SHIFT * shift * box.size)
    size = box.size * (1 + STRETCH * change)
    return replace(pair.case().in_box(OrientedBox(center, size, box.rotation)), name=f"{pair.name} box {draw}")
