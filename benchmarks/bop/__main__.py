"""Registers the objects of a folder in BOP's layout in single frames: BOP's CSV, recalls of MSSD and MSPD, verdicts.

    python -m benchmarks.bop DATASET --output FOLDER [--models FOLDER] [--split test] [--detections FILE.json | --boxes]
        [--limit N] [--method regnf ransac_icp] [--results CSV ...]

A target is looked for where the detector of --detections says; else in the mask of what is visible of it, or with
--boxes in the box round that. --results judges poses of other methods in BOP's form, in the same table, --answers those
of an earlier run.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.bop.answers import Answer, judged, read_answers, read_csv, recall, write_answers, write_csv
from benchmarks.bop.dataset import Dataset, Detections
from benchmarks.bop.registering import METHODS, register_all
from benchmarks.bop.table import listing, summary
from regnf_core.errors import RegnfError

_LONGEST_LIST = 500


def main(arguments: Sequence[str] | None = None) -> int:
    asked = _parser().parse_args(arguments)
    asked.output.mkdir(parents=True, exist_ok=True)
    try:
        dataset = Dataset.of(asked.dataset, asked.split, asked.models)
        _run(dataset, asked)
    except RegnfError as error:
        print(f"{error} {error.hint or ''}".strip(), file=sys.stderr)
        return 2
    return 0


def _run(dataset: Dataset, asked: argparse.Namespace) -> None:
    detections = Detections.read(asked.detections) if asked.detections else Detections(boxes=asked.boxes)
    targets = dataset.targets[: asked.limit]
    found: list[tuple[str, list[Answer]]] = []
    for method in asked.method:
        answers = []
        for answer in register_all(dataset, targets, detections, method, asked.seed):
            answers.append(judged(dataset, answer))
            print(listing(answers[-1:]).splitlines()[-1], file=sys.stderr)
        write_csv(asked.output / f"{method.replace('_', '')}_{dataset.folder.name}-{dataset.split}.csv", answers)
        write_answers(asked.output / f"{method}.jsonl", answers)
        found.append((method, answers))
    for file in asked.answers:
        found.append((file.stem, [judged(dataset, one) for one in read_answers(file)]))
    wanted = {(one.scene_id, one.im_id, one.obj_id) for one in targets}
    for file in asked.results:
        given = [one for one in read_csv(file) if (one.scene_id, one.im_id, one.obj_id) in wanted]
        found.append((file.stem.split("_")[0], [judged(dataset, one) for one in given]))
    parts = [f"# {dataset.folder.name}, {dataset.split}\n"]
    for name, answers in found:
        accepted = [one for one in answers if one.verdict == "registered"]
        recalls = [recall(dataset, targets, some, asked.width) for some in (answers, accepted)]
        parts.append(f"## {name}\n\n{summary(answers, *recalls)}")
    if found and len(found[0][1]) <= _LONGEST_LIST:
        parts.append(f"## Each detection\n\n{listing(found[0][1], found[1:])}")
    text = "\n".join(parts)
    (asked.output / "table.md").write_text(text)
    print(text)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.bop", description=__doc__.split("\n")[0])
    parser.add_argument("dataset", type=Path, help="the folder of a data set, with models and a split")
    parser.add_argument("--output", type=Path, required=True, help="folder for the CSV, answers and table.md")
    parser.add_argument("--models", type=Path, help="folder of obj_NNNNNN.ply and models_info.json")
    parser.add_argument("--split", help="folder of the scenes; default: test")
    place = parser.add_mutually_exclusive_group()
    place.add_argument("--detections", type=Path, help="a detector's results in BOP's form")
    place.add_argument("--boxes", action="store_true", help="boxes of what is visible in place of masks")
    parser.add_argument("--limit", type=int, help="so many targets, the first ones")
    parser.add_argument("--method", nargs="*", choices=METHODS, default=["regnf"])
    parser.add_argument("--results", nargs="*", type=Path, default=[], help="poses of other methods, BOP's CSV")
    parser.add_argument(
        "--answers", nargs="*", type=Path, default=[], help="METHOD.jsonl of earlier runs, judged again"
    )
    parser.add_argument("--width", type=int, default=640, help="of the images, pixels, for the limits of MSPD")
    parser.add_argument("--seed", type=int, default=0)
    return parser


if __name__ == "__main__":
    sys.exit(main())
