"""Table 2: true scales from 0.05 to 20."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import torch

from benchmarks.robust.cases import Case, Pair, load_pairs
from benchmarks.robust.report import Table, accuracy_section, failures_of, share_bar, successes
from benchmarks.robust.runs import Context, Job, run_all
from regnf_core import Sim3

NAME = "scales"
SCALES = (0.05, 0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 10.0, 20.0)
PAIRS = (("ac-room", "c"), ("mix-room", "fc"), ("atbl-room", "t"))


def table(context: Context) -> Table:
    """Three objects at nine scales, one seed each."""
    chosen = [pair for pair in load_pairs(context.folder) if (pair.room, pair.object) in PAIRS]
    jobs = [Job(partial(at_scale, pair, scale), f"{scale:g}") for scale in SCALES for pair in chosen]
    runs = run_all(jobs, context)
    return Table(
        NAME,
        "True scales from 0.05 to 20",
        [share_bar("all", successes(runs), len(runs), 1.0)],
        [accuracy_section("Object units for each scene unit; the object's field seen in other units.", "scale", runs)],
        runs,
        failures_of(runs),
    )


def at_scale(pair: Pair, scale: float) -> Case:
    """The pair with the object in other units, so that the true scale is ``scale``."""
    case = pair.case()
    factor = torch.tensor(scale, dtype=torch.float64) / pair.truth.scale
    change = Sim3(factor, torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    return replace(case.seen_in(Sim3.identity(), change), name=f"{pair.name} at {scale:g}")
