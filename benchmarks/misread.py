"""A fuzzer of plausible but wrong files: is any taken without a word about its error?

    python -m benchmarks.misread --count 20000 --seed 1 [--jobs 2] [--output FILE] [--keep FOLDER]

Each case is a sound file of some reader with one error that a person or a program makes: another unit, axes, sign,
order, type or byte order, a header that miscounts. It ends in one of four ways:

- refused: with a reason;
- said: taken, and a warning or an assumption of its report is about that very error;
- harmless: taken, and the field is what the file's maker meant all the same;
- silent: taken, the field is another one, and nothing is said of it.

Files are converted in this process. Ends with status 1 if there is a silent one.
"""

from __future__ import annotations

import argparse
import multiprocessing
import re
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
import torch

from benchmarks.misread_boxes import wrong_box
from benchmarks.misread_cameras import wrong_cameras
from benchmarks.misread_files import MAKERS, SOUND, Case, Random, framed, twin_of
from regnf_core.errors import FieldFormatError
from regnf_core.fields.build import open_field
from regnf_core.importing.gate.convert import FIELD_NAME, convert_file
from regnf_core.importing.gate.reading import Companions
from regnf_core.importing.gate.report import ImportLimits
from tests.core.importing.twins import Array

Ending = tuple[str, str, str, str]
"""reader, error, outcome, what was said."""
_TWINS = 40
_SHARES = {"grid": 8, "voxel blocks": 3, "nvblox": 3, "ply": 3, "ply text": 3, "obj": 3, "stl": 3, "glb": 3, "onnx": 3}
_RARE = {"xyz cloud": 0.7, "ply cloud": 0.2, "pcd cloud": 0.2, "las cloud": 0.2, "cameras": 0.5}
SHARES: dict[str, float] = {**_SHARES, **_RARE}
"""How often a reader's turn comes: those that take a second come seldom."""
_BOXES, _FRAMES = 0.1, 0.25
"""Of all cases those that are boxes; of files those that are sound in another frame or unit."""
_LIMITS = ImportLimits(work_s=1.0)
_OFF = 0.05
"""A field is the one that was meant where its values are off by less than this at most marks, in lengths of the twin's
own unit; the widest cells are 0.1."""
_CUT = 0.2
_PART = 200


def marks(case: Case) -> tuple[Array, Array]:
    """(N, 3) places around the surface that was meant, and the distances there."""
    random = np.random.default_rng(0)
    if case.meant is None:
        center, radius = (np.array(part) for part in case.options["ball"])
        away = random.normal(size=(60, 3))
        places = center + radius * random.uniform(0.8, 1.6, (60, 1)) * away / np.linalg.norm(away, axis=1)[:, None]
        return places, np.linalg.norm(places - center, axis=1) - radius
    low, high = case.meant.box(0.15)
    places = random.uniform(low, high, (400, 3))
    distance = case.meant.distance(places)
    near = np.abs(distance) < _CUT * case.meant.scale / 2
    return places[near], distance[near]


def as_meant(case: Case, path: Path) -> bool:
    """Whether the field is what the maker of the file meant."""
    places, distance = marks(case)
    scale = 0.3 if case.meant is None else case.meant.scale
    found = open_field(path).signed_distance(torch.from_numpy(places).float()).double().numpy()
    return bool((np.abs(found - distance) < _OFF * scale).mean() > 0.9)


def ending_of(case: Case, folder: Path) -> tuple[str, str]:
    """The outcome, and what was said."""
    upload = folder / "upload"
    upload.write_bytes(case.data)
    cameras = case.options.get("cameras")
    beside = None
    if cameras is not None:
        (folder / "cameras").write_bytes(cameras[1])
        beside = Companions(cameras=(cameras[0], folder / "cameras"))
    try:
        report = convert_file(upload, folder, case.options.get("description"), _LIMITS, beside=beside)
    except FieldFormatError as error:
        return "refused", error.reason
    lines: list[str] = [*report["warnings"], *report["assumed"], *report["why"]]
    told = next((line for line in lines if re.search(case.said, line)), None)
    if told is not None:
        return "said", told.partition(":")[0]
    meant = case.options.get("harmless") if cameras is not None else as_meant(case, folder / FIELD_NAME)
    return ("harmless", "") if meant else ("silent", "; ".join(line.partition(":")[0] for line in lines))


def case_of(random: Random) -> Case:
    reader = str(random.choice(list(SHARES), p=np.array(list(SHARES.values())) / sum(SHARES.values())))
    twin = twin_of(int(random.integers(_TWINS)))
    if reader == "cameras":
        return wrong_cameras(reader, twin, random)
    if reader in SOUND and (reader not in MAKERS or random.random() < _FRAMES):
        return framed(reader, twin, random)
    return MAKERS[reader](reader, twin, random)


def run(number: int, seed: int, keep: Path | None) -> Ending:
    """The case of this number, from the beginning to its end."""
    torch.set_num_threads(1)
    random = np.random.default_rng([seed, number])
    if random.random() < _BOXES:
        return ("box", *wrong_box(random))
    case = case_of(random)
    with tempfile.TemporaryDirectory(prefix="regnf-misread-") as folder:
        outcome, told = ending_of(case, Path(folder))
    if outcome == "silent" and keep is not None:
        keep.mkdir(parents=True, exist_ok=True)
        (keep / f"{number}-{case.reader}-{case.error}".replace(" ", "_").replace("/", "_")).write_bytes(case.data)
    return case.reader, case.error, outcome, told


def run_part(first: int, seed: int, keep: Path | None) -> list[Ending]:
    return [run(number, seed, keep) for number in range(first, first + _PART)]


def all_parts(count: int, jobs: int, part: Callable[[int], list[Ending]]) -> Iterator[list[Ending]]:
    """All cases, in parts as they end. A part whose process was killed from outside is begun again."""
    left = set(range(0, count, _PART))
    while left:
        with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
            waiting = {pool.submit(part, first): first for first in left}
            for done in as_completed(waiting):
                with suppress(BrokenProcessPool):
                    yield done.result()
                    left.discard(waiting[done])


OUTCOMES = ("refused", "said", "harmless", "silent")


def table(endings: list[Ending]) -> str:
    """Errors by reader, and how often each ended how."""
    counts = Counter(ending[:3] for ending in endings)
    words: dict[tuple[str, str], Counter[str]] = {}
    for reader, error, outcome, told in endings:
        if outcome != "harmless":
            words.setdefault((reader, error), Counter())[told] += 1
    lines = [f"| reader | error | {' | '.join(OUTCOMES)} | mostly |", "|---|---|---|---|---|---|---|"]
    for reader, error in sorted({ending[:2] for ending in endings}):
        numbers = (str(counts[reader, error, outcome] or "") for outcome in OUTCOMES)
        usual = ", ".join(f"`{word}`" for word, _ in words.get((reader, error), Counter()).most_common(2))
        lines.append(f"| {reader} | {error} | {' | '.join(numbers)} | {usual} |")
    totals = Counter(ending[2] for ending in endings)
    lines.append(f"| all | | {' | '.join(str(totals[outcome]) for outcome in OUTCOMES)} | |")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--output", type=Path)
    parser.add_argument("--keep", type=Path, help="where silent files are written")
    asked = parser.parse_args()
    begun = time.monotonic()
    endings: list[Ending] = []
    for part in all_parts(asked.count, asked.jobs, partial(run_part, seed=asked.seed, keep=asked.keep)):
        endings += part
        silent = sum(each[2] == "silent" for each in endings)
        print(f"{len(endings)} files, {silent} silent, {time.monotonic() - begun:.0f} s", file=sys.stderr)
    text = table(endings)
    print(text)
    silent = sum(ending[2] == "silent" for ending in endings)
    if asked.output:
        command = f"python -m benchmarks.misread --count {asked.count} --seed {asked.seed}"
        about = "# Plausible but wrong files\n\n"
        about += f"`{command}`: {len(endings)} files, {silent} taken without a word about their error.\n\n"
        asked.output.write_text(f"{about}{text}\n")
    return 1 if silent else 0


if __name__ == "__main__":
    sys.exit(main())
