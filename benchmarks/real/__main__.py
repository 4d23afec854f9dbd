"""Registration against a real depth camera: fuse, cut, fit, register, report.

    python -m benchmarks.real fuse FRAMES WORK            both halves' maps, and what the second one's frames observed
    python -m benchmarks.real cut FRAMES WORK             the things of the first half as points and as grids
    python -m benchmarks.real fit FRAMES WORK             the things, and the second half's room, by regnf fit
    python -m benchmarks.real register FRAMES WORK        one line a run, all of them in WORK/runs.json (--runs NAME)
    python -m benchmarks.real report FRAMES WORK          the tables of WORK/runs.json (--runs NAME ...)

FRAMES is a folder that the reader gets for himself (docs/real-data.md). What lies in WORK is kept, but for the runs.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before torch loads

from benchmarks.real.cases import Work
from benchmarks.real.fits import fit_room, fit_thing
from benchmarks.real.fusion import fuse
from benchmarks.real.halves import HALVES
from benchmarks.real.maps import MAPS, OBSERVATIONS, keep_observation
from benchmarks.real.objects import KINDS, cut_grid, cut_points, is_shown
from benchmarks.real.registering import Wanted, register_all
from benchmarks.real.scenes import Thing, scene_names, scene_of
from benchmarks.real.sequence import Recording, open_recording
from benchmarks.real.table import line, tables
from benchmarks.robust.runs import Run
from regnf_fit.options import ReconstructionOptions


def _fuse(recording: Recording, work: Work, voxel_m: float) -> None:
    for half, frames in zip("AB", work.halves.frames(len(recording)), strict=True):
        files = work.map_files(half)
        if not files.fused.exists():
            fuse(recording, frames, voxel_m, files.fused)
        if half == "B" and not files.seen.exists():
            keep_observation(recording, frames, files)


def _cut(work: Work, things: tuple[Thing, ...]) -> None:
    for thing in things:
        fused = work.map_files("A").fused
        if not is_shown(fused, thing):
            print(f"{work.halves.name}: {thing.name} is left out, the first half hardly shows it", flush=True)
            continue
        cut_points(fused, thing, work.object_file(thing, "points"))
        cut_grid(fused, thing, work.object_file(thing, "grid"))


def _fit(
    recording: Recording, work: Work, things: tuple[Thing, ...], only: list[str], options: ReconstructionOptions
) -> None:
    """The things, and then the room unless things are named."""
    first, second = work.halves.frames(len(recording))
    for thing in things:
        if (not only or thing.name in only) and not work.object_file(thing, "fit").exists():
            fit_thing(recording, first, work, thing, options)
    if not only and not work.map_files("B").fit.exists():
        fit_room(recording, second, work, "B", options)


def _register(work: Work, things: tuple[Thing, ...], wanted: Wanted, runs: list[Run], kept: Path) -> None:
    for run in register_all(work, things, wanted):
        runs.append(run)
        print(line(run), flush=True)
        kept.write_text(json.dumps(runs, indent=1) + "\n")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=("fuse", "cut", "fit", "register", "report"))
    parser.add_argument("frames", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--scene", choices=scene_names(), default="kitchen", help="whose boxes of boxes.json")
    parser.add_argument("--halves", nargs="+", choices=sorted(HALVES), default=sorted(HALVES, reverse=True))
    parser.add_argument("--maps", nargs="+", choices=MAPS, default=["fused"])
    parser.add_argument("--observations", nargs="+", choices=OBSERVATIONS, default=["frames"])
    parser.add_argument("--objects", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--only", nargs="+", default=[], help="names of things")
    parser.add_argument("--iterations", type=int, default=3000, help="of a fit")
    parser.add_argument("--refine-poses", action="store_true", help="of a fit")
    parser.add_argument("--runs", nargs="+", default=["runs.json"], help="files of WORK that runs are kept in")
    parser.add_argument("--stages", action="store_true", help="find out which stage loses the truth")
    return parser


def main() -> None:
    given = _parser().parse_args()
    given.work.mkdir(parents=True, exist_ok=True)
    recording, scene = open_recording(given.frames), scene_of(given.scene)
    things = scene.things
    if given.command == "report":
        print(tables([run for name in given.runs for run in json.loads((given.work / name).read_text())]))
        return
    wanted = Wanted(given.maps, given.observations, given.objects, given.seeds, given.only, given.stages)
    runs: list[Run] = []
    for name in given.halves:
        work = Work(given.work, HALVES[name])
        if given.command == "fuse":
            _fuse(recording, work, scene.voxel_m)
        elif given.command == "cut":
            _cut(work, things)
        elif given.command == "fit":
            options = ReconstructionOptions(iterations=given.iterations, refine_poses=given.refine_poses)
            _fit(recording, work, things, given.only, options)
        else:
            _register(work, things, wanted, runs, given.work / given.runs[0])
    if runs:
        print(tables(runs))


if __name__ == "__main__":
    main()
