"""The figures of the release: one command measures them, and one writes them where they are shown.

    python -m benchmarks.release run [--meshes OBJECTS FURNITURE] [--rooms ROOMS] [--real FRAMES] [--bop SETS]
                                     [--only NAME ...]
    python -m benchmarks.release write

``write`` computes every figure from the files in benchmarks/results, and writes release.json and release.md there and
the tables in README.md and docs/benchmark.md, between their markers. ``run`` measures first (`release_steps`).
"""

from __future__ import annotations

import argparse
import gzip
import itertools
import json
import math
import re
import statistics
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any

from benchmarks.robust.judging import SUCCESS
from benchmarks.worlds.tables import upper_bound
from benchmarks.worlds.trust import LEAST_SEEN, cannot_be_told, is_right
from regnf_core.robust.verdict.evaluation import LEVELS
from regnf_core.version import ENGINE_REVISION

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
KNOWN_SCALE = 0.01
"""The share within which the scale is given where depth images are the scene."""
WORLDS, KITCHEN, TIME = "worlds/answers-test.jsonl.gz", "kitchen.json", "time.json"
PAIRS, OTHERS, PEERS = "exact/pairs.json", "exact/wrong_objects.json", "exact/peers.json"
BOP = {"ycbv": "YCB-V", "lmo": "LM-O", "tyol": "TYO-L"}
TABLES = {
    "right": "your data",
    "answers": "answer, random rooms",
    "wrong": "what is requested",
    "variants": "two candidates",
    "peers": "method",
    "time": "registration",
}
"""What the tables are of: the head of the first column."""
_BY = {"images": "fused map", "recording": "depth images as the scene", "nothing": "fused map, without observation"}
_CAMERAS = {"rendered": "clean depth", "tsdf": "noisy cameras with drift"}
_LENGTHS = {"long": "full trajectory", "short": "partial trajectory", "single": "one view"}
_WRONG = {
    "other": "another object",
    "similar": "the most similar of several dozen objects",
    "part less": "the object with a part less",
    "part more": "the object with a block more",
    "resized": "a package of another size",
    "mirrored": "its mirror image",
    "longer": "the object, longer along an axis",
    "neighbor": "the object, in a neighbor's box",
    "empty": "the object, in an empty place",
}
_PEERS = {
    "regnf robust": "regnf, preset `robust`",
    "ransac_icp normalized": "RANSAC and ICP (Open3D), clouds of one size",
    "ransac_icp normalized scaled": "the same, with scale in RANSAC and ICP",
    "splatreg robust normalized": "splatreg, clouds of one size",
}
_CUSHION = "the same: an armchair with its cushion for the one without, or the reverse"
TIMED = {
    "small, model kept": "the demo's pair, with a kept object model",
    "small, cold": "the same, with making the object model",
    "full-size, model kept": "neus-facto networks of the default size, with a kept object model",
}
_README = ("exact", "images/rendered", "images/tsdf", "recording/rendered", "recording/tsdf", "nothing/rendered",
           "kitchen", "bop/ycbv")  # fmt: skip
"""Beginnings of the ids of the README's rows; those of one beginning share a row."""
_MARKED = re.compile(r"(<!-- release-table(?:: (\w+))? -->\n).*?(<!-- /release-table -->)", flags=re.S)

Run = dict[str, Any]
Test = Callable[[Run], bool]


@dataclass(frozen=True)
class Row:
    """what: the data, in words · figures: by column · revision: of the engine; None: not known, or several ·
    source: the file in benchmarks/results."""

    id: str
    table: str
    what: str
    figures: dict[str, str]
    revision: int | None
    command: str
    source: str


def read(source: str) -> list[Run]:
    """The runs in a file of benchmarks/results."""
    path = RESULTS / source
    text = gzip.decompress(path.read_bytes()).decode() if path.suffix == ".gz" else path.read_text()
    if ".jsonl" in source:
        return [json.loads(line) for line in text.splitlines()]
    found: list[Run] = json.loads(text)["runs"]
    return found


def revision_of(runs: Sequence[Run]) -> int | None:
    found = {run.get("revision") for run in runs}
    return found.pop() if len(found) == 1 else None


def rows() -> list[Row]:
    """Every figure, computed from the committed results."""
    return [*_right(), *_answers(), *_wrong(), *_variants(), *_peers(), *_time()]


def _row(name: str, what: str, figures: dict[str, str], runs: Sequence[Run], step: str, source: str) -> Row:
    """name: begins with its table's."""
    command = f"python -m benchmarks.release run --only {step}"
    return Row(name, name.partition("/")[0], what, figures, revision_of(runs), command, source)


def _of(hits: int, total: int) -> str:
    return f"{hits} of {total} ({100 * hits / total:.0f} %)" if total else "0 of 0"


def _wrong_of(wrong: int, total: int) -> str:
    """With the exact one-sided 95 % bound."""
    return f"{wrong} of {total} (at most {100 * upper_bound(wrong, total):.0f} %)" if total else "0 of 0"


def _share(runs: Sequence[Run], taken: Test) -> str:
    return f"{sum(map(taken, runs))} of {len(runs)}"


def _accepted(run: Run) -> bool:
    return bool(run["verdict"] in ("registered", "ambiguous"))


def _strictly(run: Run) -> bool:
    return _accepted(run) and bool(run["probability"] >= LEVELS["strict"])


def _right_figures(runs: Sequence[Run], right: Test, taken: Test = _accepted) -> dict[str, str]:
    accepted = [run for run in runs if taken(run)]
    good = sum(map(right, accepted))
    return {
        "correct pose": _of(sum(map(right, runs)), len(runs)),
        "correct and accepted": _of(good, len(runs)),
        "wrong among accepted": _wrong_of(len(accepted) - good, len(accepted)),
    }


def _asked(question: str) -> list[Run]:
    """Of the random worlds, without wrong objects that what was seen does not tell from the right one."""
    runs = [run for run in read(WORLDS) if run["winner"] and run["found"] and run["seed"] == 0]
    return [run for run in runs if run["question"] == question and not cannot_be_told(run)]


def _right() -> Iterator[Row]:
    """The right object is requested."""
    asked, beside = _asked("right"), _asked("half beside")
    for key in itertools.product(_BY, _CAMERAS, _LENGTHS):
        runs = [run for run in asked if (run["observed_by"], run["scene"], run["length"]) == key]
        if runs:
            by, scene, length = key
            share = runs[0].get("known_scale", KNOWN_SCALE) if by == "recording" else None
            known = f", scale known within {100 * share:g} %" if share else ""
            what = f"{_BY[by]}{known}, {_CAMERAS[scene]}, {_LENGTHS[length]}"
            yield _row(f"right/{'/'.join(key)}", what, _right_figures(runs, is_right), runs, "worlds", WORLDS)
    for name, what, runs, taken in (
        ("beside", "fused maps, the box half beside the object", beside, _accepted),
        ("all", "all random rooms, box around the object", asked, _accepted),
        ("strict", "the same, with `acceptance: strict`", asked, _strictly),
    ):
        yield _row(f"right/{name}", what, _right_figures(runs, is_right, taken), runs, "worlds", WORLDS)
    runs = [run for run in read(PAIRS) if run["group"].startswith("main")]
    pairs, seeds = (len({run[key] for run in runs}) for key in ("group", "seed"))
    what, figures = f"exact grids of furniture, {pairs} pairs, {seeds} seeds", _right_figures(runs, _near("mssd_share"))
    yield _row("right/exact", what, figures, runs, "exact", PAIRS)
    for name, title in BOP.items():
        runs, source = read(f"bop/{name}.jsonl"), f"bop/{name}.jsonl"
        what, figures = f"{title}, real depth images, masks", _right_figures(runs, _near("listed"))
        yield _row(f"right/bop/{name}", what, figures, runs, "bop", source)
    for halves, what, right in (
        ("interleaved", "a recorded kitchen, map from other frames of the same pass", "right"),
        ("apart", "a recorded kitchen, map from another side, drift removed", "right_within_drift"),
    ):
        runs = [run for run in read(KITCHEN) if run["halves"] == halves]
        figures = _right_figures([run for run in runs if run["shown"]], itemgetter(right))
        figures["wrong among accepted"] = _right_figures(runs, itemgetter(right))["wrong among accepted"]
        yield _row(f"right/kitchen/{halves}", what, figures, runs, "real", KITCHEN)


def _near(error: str) -> Test:
    return lambda run: bool(run.get(error, SUCCESS + 1.0) <= SUCCESS)


def _answers() -> Iterator[Row]:
    for verdict in ("registered", "ambiguous"):
        runs = [run for run in _asked("right") if run["verdict"] == verdict]
        wrong = [run["listed_mssd"] for run in runs if not is_right(run)]
        off = math.ceil(100 * max(wrong, default=0.0))
        figures = {"wrong": _wrong_of(len(wrong), len(runs)), "largest error of these": f"{off} %"}
        yield _row(f"answers/{verdict}", f"`{verdict}`", figures, runs, "worlds", WORLDS)


def _wrong() -> Iterator[Row]:
    """Another object is requested than stands in the box."""
    found = [
        (what, [run for run in _asked(one) if not is_right(run)], "worlds", WORLDS) for one, what in _WRONG.items()
    ]
    others = [run for run in read(OTHERS) if run["group"].startswith("wrong")]
    for cushion, what in enumerate(("other furniture, in exact rooms without an observation", _CUSHION)):
        found.append((what, [run for run in others if ("cushion" in run["group"]) == cushion], "exact", OTHERS))
    for what, runs, step, source in (one for one in found if one[1]):
        figures = {"accepted": _share(runs, _accepted), "accepted at `strict`": _share(runs, _strictly)}
        yield _row(f"wrong/{what}", what, figures, runs, step, source)


def _variants() -> Iterator[Row]:
    compared = [run for run in read(WORLDS) if run.get("difference") and not is_right(run)]
    told = [run for run in compared if run["difference"]["distinguishable"]]
    unseen = [run for run in compared if run["seen_difference"] < LEAST_SEEN / 2.0]
    favored = _of(sum(run["difference"]["favor"] > 0.0 for run in told), len(told))
    said = _of(sum(not run["difference"]["distinguishable"] for run in unseen), len(unseen))
    for name, what, figure, runs in (
        ("told", "where `distinguishable` is true: the right one is favored", favored, told),
        ("unseen", "where the difference was not observed: `distinguishable` is false", said, unseen),
    ):
        yield _row(f"variants/{name}", what, {"how often": figure}, runs, "worlds", WORLDS)


def _peers() -> Iterator[Row]:
    for group, what in _PEERS.items():
        runs = [run for run in read(PEERS) if run["group"] == group]
        error = statistics.median(run["mssd_share"] for run in runs if "mssd_share" in run)
        figures = {"solved": _share(runs, _near("mssd_share")), "median error": f"{100 * error:.2g} %"}
        yield _row(f"peers/{group}", what, figures, runs, "peers", PEERS)


def _time() -> Iterator[Row]:
    for run in read(TIME):
        figures = {"processor seconds, one thread": f"{run['seconds']:.2f}"}
        yield _row(f"time/{run['case']}", TIMED[run["case"]], figures, [run], "time", TIME)


# What is written.


def table(name: str, found: Sequence[Row]) -> str:
    """Markdown. A row of another revision of the engine than the shipped one says so."""
    some = [row for row in found if row.table == name]
    columns = list(some[0].figures)
    lines = [[_what(row), *(row.figures[column] for column in columns)] for row in some]
    return _markdown([TABLES[name], *columns], lines)


def readme_table(found: Sequence[Row]) -> str:
    """The selection for the README: the lengths of the trajectory in one row, wrong answers summed up."""
    lines = []
    for start in _README:
        some = [row for row in found if f"{row.id}/".startswith(f"right/{start}/")]
        if start.startswith(tuple(_BY)):
            label = _what(some[0]).replace(", full trajectory", ": full trajectory, partial, one view")
        else:
            label = "; ".join(map(_what, some))
        wrong, total = map(sum, zip(*(_numbers(row.figures["wrong among accepted"]) for row in some), strict=True))
        good = ", ".join(row.figures["correct and accepted"].partition(" (")[0] for row in some)
        lines.append([label, good, f"{wrong} of {total}"])
    return _markdown(["data", "correct and accepted", "wrong among accepted"], lines)


def _numbers(figure: str) -> tuple[int, int]:
    hits, _, total = figure.partition(" (")[0].partition(" of ")
    return int(hits), int(total)


def _what(row: Row) -> str:
    return row.what if row.revision == ENGINE_REVISION else f"{row.what} (engine revision {row.revision or 'unknown'})"


def _markdown(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    return "\n".join("| " + " | ".join(line) + " |" for line in [head, ["---"] * len(head), *lines])


def filled(text: str, found: Sequence[Row]) -> str:
    """A page with its tables: between markers with the name of a table that one, else the README's."""

    def block(match: re.Match[str]) -> str:
        start, name, end = match.groups()
        return f"{start}\n{readme_table(found) if name is None else table(name, found)}\n\n{end}"

    return _MARKED.sub(block, text)


def pages(found: Sequence[Row]) -> dict[Path, str]:
    """Every file that ``write`` writes."""
    shown = {path: filled(path.read_text(), found) for path in (ROOT / "README.md", ROOT / "docs" / "benchmark.md")}
    listed = json.dumps([asdict(row) for row in found], indent=1, ensure_ascii=False) + "\n"
    return {RESULTS / "release.json": listed, RESULTS / "release.md": _report(found), **shown}


def _report(found: Sequence[Row]) -> str:
    parts = [
        "# Figures of the release",
        "`python -m benchmarks.release write` makes this page and `release.json` from the files named here.",
    ]
    for name, head in TABLES.items():
        some = [row for row in found if row.table == name]
        columns = list(some[0].figures)
        lines = [
            [row.what, *row.figures.values(), str(row.revision or "unknown"), f"`{row.command}`", f"`{row.source}`"]
            for row in some
        ]
        parts.append(_markdown([head, *columns, "engine revision", "command", "file"], lines))
    return "\n\n".join(parts) + "\n"


def write() -> None:
    for path, text in pages(rows()).items():
        path.write_text(text)


def main() -> None:
    from benchmarks import release_steps

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    release_steps.add_options(
        commands.add_parser("run", help="measure what is not measured with this engine, then write")
    )
    commands.add_parser("write", help="the figures of the files in benchmarks/results")
    arguments = parser.parse_args()
    if arguments.command == "run":
        release_steps.run(arguments)
    write()


if __name__ == "__main__":
    main()
