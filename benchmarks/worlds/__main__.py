"""Random worlds: make them, register their objects, and print what was found and where the truth was lost.

    python -m benchmarks.worlds make FOLDER --meshes DIR [DIR ...] --part train --count 20
    python -m benchmarks.worlds register FOLDER --part train --output runs.jsonl
    python -m benchmarks.worlds report runs.jsonl [--output report.md]
    python -m benchmarks.worlds covariance runs.jsonl [--output factors.md]
    python -m benchmarks.worlds worst FOLDER runs.jsonl --output worst.png
    python -m benchmarks.worlds evidence FOLDER --part train --output evidence.jsonl
    python -m benchmarks.worlds train evidence.jsonl --output probability.json --table left-out.md
    python -m benchmarks.worlds trust evidence.jsonl --output trust.md --diagrams FOLDER

One seed is one world; a world is made once and kept. The part `test` is for reporting: choose nothing on it.
"""

from __future__ import annotations

import argparse
import gzip
import itertools
import json
import multiprocessing
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # before torch loads, here and in the workers

from benchmarks.random_worlds.models import PARTS, part_of_world, seeds_of  # noqa: E402
from benchmarks.random_worlds.walks import LENGTHS  # noqa: E402
from benchmarks.worlds import covariance, tables, training, trust  # noqa: E402
from benchmarks.worlds.cases import OBSERVED_BY  # noqa: E402
from benchmarks.worlds.evidence import Gathering, evidence_of_world  # noqa: E402
from benchmarks.worlds.making import WORLD, Task, make  # noqa: E402
from benchmarks.worlds.objects import OBJECT_KINDS  # noqa: E402
from benchmarks.worlds.questions import KINDS  # noqa: E402
from benchmarks.worlds.recipe import SCENES, parts_of_name  # noqa: E402
from benchmarks.worlds.running import Run, Way, register_world  # noqa: E402
from benchmarks.worlds.worst import picture_of, worst_of  # noqa: E402
from regnf_core.robust.verdict.answer import ProbabilityModel  # noqa: E402


def main() -> None:
    arguments = _parser().parse_args()
    commands: dict[str, Callable[[argparse.Namespace], None]] = {
        "make": _make,
        "register": _register,
        "report": partial(_table, markdown=tables.markdown),
        "covariance": partial(_table, markdown=covariance.markdown),
        "worst": _worst,
        "evidence": _evidence,
        "train": _train,
        "trust": _trust,
    }
    commands[arguments.command](arguments)


def _make(arguments: argparse.Namespace) -> None:
    absent = [folder for folder in arguments.meshes if not folder.is_dir()]
    if absent:
        sys.exit(f"no folder of meshes: {', '.join(map(str, absent))}; say where they are with --meshes")
    seeds = arguments.seeds or list(
        itertools.islice(seeds_of(arguments.part), arguments.start, arguments.start + arguments.count)
    )
    meshes = tuple(arguments.meshes)
    tasks = [
        Task(seed, length, arguments.scene, meshes, arguments.folder, arguments.objects)
        for seed in seeds
        for length in arguments.lengths
    ]
    for line in _in_parallel(make, tasks, arguments.workers):
        _say(line)


def _register(arguments: argparse.Namespace) -> None:
    homes = _homes(arguments)
    way = Way(arguments.registration_seed, arguments.observed_by, not arguments.quick, arguments.known_scale)
    done = 0
    with arguments.output.open("a") as file:
        for runs in _in_parallel(partial(register_world, way=way), homes, arguments.workers):
            for run in runs:
                file.write(json.dumps(run) + "\n")
            file.flush()
            done += 1
            _say(f"{done}/{len(homes)} {tables.summary(runs)}")


def _homes(arguments: argparse.Namespace) -> list[Path]:
    """The folders of the worlds that the arguments name."""
    chosen = []
    for home in sorted(path.parent for path in arguments.folder.glob(f"*/{WORLD}")):
        scene, seed, length = parts_of_name(home.name)
        wanted = scene == arguments.scene and length in arguments.lengths and part_of_world(seed) == arguments.part
        if wanted and (not arguments.seeds or seed in arguments.seeds):
            chosen.append(home)
    return chosen


def _evidence(arguments: argparse.Namespace) -> None:
    homes = _homes(arguments)
    known = sorted(path.parent for path in arguments.folder.glob(f"*/{WORLD}"))
    gathering = Gathering(
        arguments.observed_by, arguments.cases, tuple(arguments.kinds), arguments.wrong, not arguments.answers_alone,
        arguments.registration_seed, arguments.known_scale,
    )  # fmt: skip
    work = partial(evidence_of_world, known=known, gathering=gathering)
    with arguments.output.open("a") as file:
        for rows in _in_parallel(work, homes, arguments.workers):
            kept = [row for row in rows if row["winner"] or not arguments.answers_alone]
            file.writelines(json.dumps(row) + "\n" for row in kept)
            file.flush()
            _say(f"{rows[0]['world'] if rows else 'a world'}: {len(rows)} poses")


def _train(arguments: argparse.Namespace) -> None:
    stored = {} if arguments.prior is None else json.loads(arguments.prior.read_text())
    found = training.trained(
        _read(arguments.rows), {name: ProbabilityModel.from_dict(one) for name, one in stored.items()}
    )
    arguments.output.write_text(json.dumps(stored | found.models, indent=1) + "\n")
    text = trust.trust_table(found.answers)
    if arguments.table is not None:
        arguments.table.write_text(f"# Wrong among accepted, in worlds left out of the training\n\n{text}")
    _say(text)


def _trust(arguments: argparse.Namespace) -> None:
    rows = _read(arguments.rows)
    text = trust.trust_table(rows)
    if arguments.output is None:
        sys.stdout.write(text)
    else:
        arguments.output.write_text(f"# Wrong among accepted\n\n{text}")
    if arguments.diagrams is not None:
        for kind, picture in trust.reliability_diagrams(rows).items():
            name = re.sub(r"[^a-z]+", "-", kind).strip("-")
            (arguments.diagrams / f"reliability-{name}.svg").write_text(picture)


def _read(paths: Sequence[Path]) -> list[dict[str, Any]]:
    return [json.loads(line) for path in paths for line in _text(path).splitlines()]


def _worst(arguments: argparse.Namespace) -> None:
    picture_of(worst_of(_read(arguments.runs), arguments.count), arguments.folder).save(arguments.output)


def _text(path: Path) -> str:
    """Of a file that may be compressed by gzip, as its name says."""
    data = path.read_bytes()
    return (gzip.decompress(data) if path.suffix == ".gz" else data).decode()


def _table(arguments: argparse.Namespace, markdown: Callable[[Sequence[Run]], str]) -> None:
    runs = [json.loads(line) for path in arguments.runs for line in path.read_text().splitlines()]
    text = markdown(runs)
    if arguments.output is None:
        sys.stdout.write(text)
    else:
        arguments.output.write_text(text)


def _in_parallel(work, tasks, workers) -> Iterator:  # type: ignore[no-untyped-def, type-arg]
    """What ``work`` makes of each task, as it comes. With several workers, it must not be a function of this module:
    a new process does not load the module that a command starts from."""
    if workers <= 1:
        yield from map(work, tasks)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        for done in as_completed([pool.submit(work, task) for task in tasks]):
            yield done.result()


def _say(line: str) -> None:
    sys.stderr.write(line + "\n")
    sys.stderr.flush()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    _add_commands_on_worlds(commands)
    _add_training(commands)
    _add_commands_on_runs(commands)
    return parser


def _add_commands_on_worlds(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    making = commands.add_parser("make", help="make worlds")
    making.add_argument("--meshes", type=Path, nargs="+", required=True)
    making.add_argument("--count", type=int, default=10)
    making.add_argument("--objects", choices=OBJECT_KINDS, help="make all objects' fields so; otherwise as drawn")
    making.add_argument("--start", type=int, default=0, help="leave out so many of the part's worlds")
    registering = commands.add_parser("register", help="register every object of the worlds in a folder")
    registering.add_argument("--output", type=Path, required=True, help="JSON lines, added to")
    registering.add_argument("--quick", action="store_true", help="do not look into the stages")
    gathering = commands.add_parser("evidence", help="poses with their evidence, for `train`")
    gathering.add_argument("--output", type=Path, required=True, help="JSON lines, added to")
    gathering.add_argument("--cases", type=int, default=8, help="of each world, at most")
    gathering.add_argument("--kinds", choices=KINDS, nargs="+", default=list(KINDS), help="of questions")
    gathering.add_argument("--wrong", type=int, help="so many questions of a case that are not about the right object")
    gathering.add_argument("--answers-alone", action="store_true", help="of the poses, keep what was answered")
    for command in (registering, gathering):
        command.add_argument("--observed-by", choices=OBSERVED_BY, default="images", help="what tells what was seen")
        command.add_argument("--registration-seed", type=int, default=0)
        command.add_argument("--known-scale", type=float, metavar="SHARE", help="say the scale, give or take so much")
    for command in (making, registering, gathering):
        command.add_argument("folder", type=Path)
        command.add_argument("--part", choices=PARTS, default="train")
        command.add_argument("--scene", choices=SCENES, default="tsdf")
        command.add_argument("--lengths", nargs="+", choices=LENGTHS, default=list(LENGTHS))
        command.add_argument("--seeds", type=int, nargs="*", help="these worlds alone")
        command.add_argument("--workers", type=int, default=1)


def _add_training(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    learning = commands.add_parser("train", help="the verdict's probability models")
    learning.add_argument("--output", type=Path, required=True, help="the models, JSON")
    learning.add_argument("--prior", type=Path, help="earlier models; new weights are penalized by what they differ")
    learning.add_argument("--table", type=Path, help="how far they can be trusted in worlds left out, Markdown")
    trusting = commands.add_parser("trust", help="of accepted answers, how many are wrong")
    trusting.add_argument("--output", type=Path, help="Markdown; otherwise it is printed")
    trusting.add_argument("--diagrams", type=Path, help="a folder for reliability diagrams, SVG")
    for command in (learning, trusting):
        command.add_argument("rows", type=Path, nargs="+", help="what `evidence` wrote, as it is or compressed by gzip")


def _add_commands_on_runs(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    showing = commands.add_parser("worst", help="a picture of the wrong poses that the engine was surest of")
    showing.add_argument("folder", type=Path, help="of the worlds")
    showing.add_argument("runs", type=Path, nargs="+", help="what `register` or `evidence` wrote")
    showing.add_argument("--count", type=int, default=10)
    showing.add_argument("--output", type=Path, required=True, help="an image file")
    reporting = commands.add_parser("report", help="tables of runs")
    fitting = commands.add_parser("covariance", help="the covariance's two factors, fitted to right poses of runs")
    for command in (reporting, fitting):
        command.add_argument("runs", type=Path, nargs="+", help="what `register` wrote")
        command.add_argument("--output", type=Path, help="Markdown; otherwise it is printed")


if __name__ == "__main__":
    main()
