"""Print the table of regnf and its peers.

    python -m benchmarks.peers FIELDS [--pairs pairs.json] [--cases CASE ...] [--only NAME ...] [--seeds 3]
                               [--limit N] [--full] [--output FILE]

FIELDS is the folder that benchmarks.make_fields wrote. With --output FILE.md the table is written there and every
single run to FILE.json. nerf2nerf takes its published 10,000 steps with --full, else a tenth of them, and the table
says so. --cases: only the pairs so named, as in the table ("ac-room mc"). --limit: the first N pairs only. A method
whose package is missing is skipped, and the table says so.
"""

from __future__ import annotations

import argparse
import os
import shlex
import sys
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before torch loads

from benchmarks.peers.interface import Peer, sampled
from benchmarks.peers.judging import no_points, run_one
from benchmarks.peers.nerf2nerf import STEPS, Nerf2nerf
from benchmarks.peers.registry import PEERS
from benchmarks.peers.table import table
from benchmarks.robust.cases import MAIN, load_pairs
from benchmarks.robust.report import write
from benchmarks.robust.runs import Run, summary
from regnf_core import RegnfError

SHORT_STEPS = STEPS // 10


def main() -> None:
    arguments = _arguments()
    makers: dict[str, Callable[[], Peer]] = {name: PEERS[name].make for name in arguments.only}
    notes = []
    if "nerf2nerf" in makers and not arguments.full:
        makers["nerf2nerf"] = lambda: Nerf2nerf(SHORT_STEPS)
        notes.append(f"nerf2nerf took {SHORT_STEPS:,} steps, not its published {STEPS:,}: --full takes them all.")
    pairs = load_pairs(arguments.fields, arguments.pairs)
    pairs = [pair for pair in pairs if not arguments.cases or pair.name in arguments.cases][: arguments.limit]
    if not pairs:
        sys.exit(f"no such pairs in {arguments.fields / arguments.pairs}")
    runs: list[Run] = []
    for pair in pairs:
        try:
            case = sampled(pair.case(), pair.diameter)
        except RegnfError as error:
            runs += [no_points(name, pair.name, error) for name in makers]
            continue
        for name, make in makers.items():
            for seed in range(arguments.seeds):
                runs.append(run_one(name, make, case, seed))
                print(_line(runs[-1]), file=sys.stderr, flush=True)
        _write(runs, notes, arguments, lambda _: None)  # what is done outlasts an interruption
    _write(runs, notes, arguments, print)


def _write(runs: list[Run], notes: list[str], arguments: argparse.Namespace, show: Callable[[str], None]) -> None:
    output = arguments.output
    done = len({run["case"] for run in runs})
    finished = table(output.stem if output else "peers", runs, [*notes, f"{done} pairs."])
    write(finished, _command(arguments), output.parent if output else None, show)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("fields", type=Path)
    parser.add_argument("--pairs", default=MAIN, help="the list of pairs in FIELDS")
    parser.add_argument("--cases", nargs="+", metavar="CASE", default=[])
    parser.add_argument("--only", nargs="+", choices=list(PEERS), default=list(PEERS), metavar="NAME")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--limit", type=int)
    parser.add_argument("--output", type=Path)
    parser.add_argument("--full", action="store_true")
    return parser.parse_args()


def _line(run: Run) -> str:
    return summary(run) if "seconds" in run else f"{run['group']}: {run['case']}: {run['reason']}"


def _command(arguments: argparse.Namespace) -> str:
    """The command without the folders' own names, which differ from machine to machine."""
    parts = ["python -m benchmarks.peers FIELDS"]
    if arguments.pairs != MAIN:
        parts.append(f"--pairs {shlex.quote(arguments.pairs)}")
    if arguments.cases:
        parts.append("--cases " + " ".join(shlex.quote(case) for case in arguments.cases))
    if arguments.only != list(PEERS):
        parts.append("--only " + " ".join(arguments.only))
    parts.append(f"--seeds {arguments.seeds}")
    if arguments.limit is not None:
        parts.append(f"--limit {arguments.limit}")
    return " ".join([*parts, "--full"] if arguments.full else parts)


if __name__ == "__main__":
    main()
