"""Table 10: the evaluator's closed form against plain autograd, and against what the machine can do at best."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from benchmarks.robust.cases import FULL_SIZE, load_pairs
from benchmarks.robust.evaluator_process import POINTS, RUNS
from benchmarks.robust.fresh import in_fresh_process
from benchmarks.robust.report import Bar, Section, Table
from benchmarks.robust.runs import Context, Run

NAME = "evaluator"
THREADS = (1, 2)
DEMO = Path(__file__).parents[2] / "examples" / "data" / "mix-room.safetensors"


def table(context: Context) -> Table:
    """The demo's room, and the room of full size where it has been made."""
    fields = {"demo field": DEMO}
    for pair in load_pairs(context.folder, FULL_SIZE):
        fields["full-size field"] = context.folder / f"{pair.room}.safetensors"
    runs: list[Run] = []
    for name, path in fields.items():
        for threads in THREADS:
            found: Run = in_fresh_process("benchmarks.robust.evaluator_process", threads, str(path))
            runs.append({"field": name, **found, **against_limits(found)})
            context.show(f"{name}, {threads} thread(s): {found['ratio']:.1f} times as fast")
    return Table(
        NAME,
        "Field evaluation",
        [Bar(f"{_name(run)}: at least 3 times", f"{run['ratio']:.2f} times", run["ratio"] >= 3.0) for run in runs],
        [
            Section(
                f"Signed distance and gradient at {POINTS:,} points spread evenly over the field's bounds: medians of "
                f"{RUNS} alternating runs in one process. Plain: a torch module straight from the formulas, gradient "
                "by autograd.",
                ("field", "ours ms", "plain ms", "times as fast", "largest difference", "gradient, 99th percentile"),
                [_speed_row(run) for run in runs],
            ),
            Section(
                "The same machine's best rates in the same process: matrix products of the network's shapes and a "
                "large one, and rows fetched at random from the hash table. Share: the time that the network's FLOP "
                "and the rows would take at these rates (shapes of the network), of the time that an evaluation "
                "takes. The rest is softplus, interpolation, hashing and the encodings.",
                (
                    "field",
                    "FLOP a point",
                    "bytes gathered a point",
                    "GFLOP/s large",
                    "GFLOP/s same shapes",
                    "gather GB/s",
                    "products' share",
                    "gathers' share",
                    "both",
                ),
                [_limit_row(run) for run in runs],
            ),
        ],
        runs,
        [],
        success="Both evaluators give the same values to float32's precision; the bar is on speed.",
    )


def against_limits(found: dict[str, Any]) -> dict[str, float]:
    """Shares of an evaluation's time that its products and its gathers need at the machine's best rates."""
    products = POINTS * found["flop_per_point"] / found["same_shape_flops"] / found["ours"]
    gathers = POINTS * found["gathered_bytes_per_point"] / found["gather_bytes_per_second"] / found["ours"]
    return {"products_share": products, "gathers_share": gathers}


def _name(run: Run) -> str:
    return f"{run['field']}, {run['threads']} thread(s)"


def _speed_row(run: Run) -> list[str]:
    return [
        _name(run),
        f"{1000 * run['ours']:.1f}",
        f"{1000 * run['plain']:.1f}",
        f"{run['ratio']:.2f}",
        f"{run['value_difference']:.1e}",
        f"{run['gradient_difference']:.1e}",
    ]


def _limit_row(run: Run) -> list[str]:
    return [
        _name(run),
        f"{run['flop_per_point']:,.0f}",
        f"{run['gathered_bytes_per_point']:,.0f}",
        f"{run['large_flops'] / 1e9:.0f}",
        f"{run['same_shape_flops'] / 1e9:.0f}",
        f"{run['gather_bytes_per_second'] / 1e9:.2f}",
        f"{100 * run['products_share']:.0f} %",
        f"{100 * run['gathers_share']:.0f} %",
        f"{100 * (run['products_share'] + run['gathers_share']):.0f} %",
    ]
