"""Print the tables of the preset `robust`.

    python -m benchmarks.robust FIELDS [--only NAME ...] [--seeds 10] [--limit N] [--output FOLDER]

FIELDS is the folder that benchmarks.make_fields wrote; for imperfect, unobserved and roc, which run only when named,
that of benchmarks.make_image_fields. With --output every table is written to FOLDER as NAME.md and,
with each single run, NAME.json. --limit is for a look beforehand: at most N registrations a table.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before torch loads

from benchmarks.robust import (
    boxes,
    covariance,
    evaluator,
    imperfect,
    library,
    one_view,
    orientations,
    pairs,
    roc,
    scales,
    speed,
    symmetry,
    wrong_objects,
)
from benchmarks.robust.report import write
from benchmarks.robust.runs import Context

TABLES = {
    module.NAME: module.table
    for module in (
        pairs,
        scales,
        orientations,
        boxes,
        one_view,
        wrong_objects,
        symmetry,
        covariance,
        speed,
        evaluator,
        library,
    )
}
IMAGE_TABLES = {
    imperfect.NAME: imperfect.table,
    imperfect.UNOBSERVED: imperfect.unobserved_table,
    roc.NAME: roc.table,
}
"""Of fields fitted to images: run when they are named."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("fields", type=Path)
    parser.add_argument("--only", nargs="+", choices=sorted(TABLES | IMAGE_TABLES), default=list(TABLES))
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--limit", type=int)
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    context = Context(
        arguments.fields, arguments.seeds, arguments.limit, lambda line: print(line, file=sys.stderr, flush=True)
    )
    limit = f" --limit {arguments.limit}" if arguments.limit else ""
    for name in arguments.only:
        command = f"python -m benchmarks.robust FIELDS --only {name} --seeds {arguments.seeds}{limit}"
        write((TABLES | IMAGE_TABLES)[name](context), command, arguments.output, print)


if __name__ == "__main__":
    main()
