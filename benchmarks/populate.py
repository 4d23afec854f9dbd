"""Whole scenes populated: random worlds, and the rooms of the paper; what is found, what is placed wrong, the time.

    python -m benchmarks.populate worlds WORLDS --meshes DIR [DIR ...] --part test --scene rendered --library 50 \\
        --output rows.jsonl
    python -m benchmarks.populate rooms FIELDS --output rows.jsonl
    python -m benchmarks.populate report rows.jsonl [--output benchmarks/results/populate.md]

WORLDS as `benchmarks.worlds make` makes them, FIELDS as `benchmarks.make_fields --only main`. The library of a world
holds the models of its things and others that stand nowhere in it. A placement is right where its MSSD, over the
model's symmetries, is at most 5 % of the diameter for the pose or one of its alternatives, or where its whole surface
is that of a thing within 1.5 %: two models may be alike. Beside it: every object of a case registered in its true box.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np  # noqa: E402
import torch  # noqa: E402
from scipy.spatial import cKDTree  # noqa: E402

from benchmarks.random_worlds.models import Model, part_of_world, read_catalog  # noqa: E402
from benchmarks.random_worlds.symmetries import measure_symmetries  # noqa: E402
from benchmarks.random_worlds.walks import make_world  # noqa: E402
from benchmarks.robust.cases import load_pairs, open_field  # noqa: E402
from benchmarks.robust.library_objects import GIVEN  # noqa: E402
from benchmarks.symmetric_errors import Symmetries, surface_displacement  # noqa: E402
from benchmarks.worlds.cases import cases_of, room_field  # noqa: E402
from benchmarks.worlds.making import WORLD  # noqa: E402
from benchmarks.worlds.recipe import parts_of_name  # noqa: E402
from regnf_core import RegistrationOptions, Sim3  # noqa: E402
from regnf_core.fields.mesh import MeshField  # noqa: E402
from regnf_core.library import LibraryObject, model_object, register  # noqa: E402
from regnf_core.options import RobustOptions  # noqa: E402
from regnf_core.population.placements import Placement, placed_samples  # noqa: E402
from regnf_core.population.populate import Population, populate  # noqa: E402

_RIGHT, _ALIKE, _LARGE = 0.05, 0.015, 40.0
"""Share of the diameter of a right pose, and of a twin's surface; voxels across a large thing."""


@dataclass(frozen=True, eq=False)
class Thing:
    """What stands in a scene. number: of its model in the library · points: (N, 3) of the model's surface · T: the
    model's pose in the scene · voxels: across it, 0 for what was hardly seen."""

    number: int
    points: torch.Tensor
    T: Sim3
    symmetries: Symmetries
    diameter: float
    voxels: float = 0.0


def right_thing(placement: Placement, points: torch.Tensor, things: Sequence[Thing]) -> int | None:
    """The thing that a placement of a model with surface ``points`` (N, 3) is right for; None: there is none."""
    for number, thing in enumerate(things):
        poses = [placement.T_object_scene, *placement.alternatives]
        if thing.number == placement.number:
            limit = _RIGHT * thing.diameter
            off = [surface_displacement(T, thing.T.inverse(), thing.points, thing.symmetries) for T in poses]
            if min(float(one.amax(1).min()) for one in off) <= limit * max(1.0, float(thing.T.scale)):
                return number
        there = thing.T.apply(thing.points).numpy()
        for T in poses:
            mine = T.apply_inverse(points).numpy()
            apart = [np.quantile(cKDTree(a).query(b)[0], 0.99) for a, b in ((mine, there), (there, mine))]
            if max(apart) <= _ALIKE * thing.diameter * float(thing.T.scale):
                return number
    return None


def deepest(found: Population) -> float:
    """How deep any two placed objects, or an object and the boundary, reach into each other at most: spacings, but for
    2 % of the samples."""
    worst, spacing = 0.0, found.surface.spacing
    for one in found.placements:
        points = placed_samples(found.library[one.number].model, one.T_object_scene)
        depths = [-plane.height(points.numpy()) for plane in found.surface.boundary]
        for other in found.placements:
            if other is not one:
                field, T = found.library[other.number].field(), other.T_object_scene
                inside = T.apply(points)
                low, high = field.bounds
                within = ((inside > low) & (inside < high)).all(-1)
                value = torch.zeros(len(points)).double()
                value[within] = -field.signed_distance(inside[within].float()).double() / float(T.scale)
                depths.append(value.numpy())
        worst = max([worst, *(float(np.quantile(one, 0.98)) / spacing for one in depths)])
    return worst


def judged(
    found: Population, surfaces: Sequence[torch.Tensor], things: Sequence[Thing], seconds: float
) -> dict[str, Any]:
    right = [right_thing(one, surfaces[one.number], things) for one in found.placements]
    large = [number for number, one in enumerate(things) if one.voxels >= _LARGE]
    return {
        "things": len(things),
        "found": len({one for one in right if one is not None}),
        "large": len(large),
        "large_found": sum(number in right for number in large),
        "placed": len(right),
        "wrong": [found.placements[n].name for n, one in enumerate(right) if one is None],
        "twice": len([one for one in right if one is not None]) - len({one for one in right if one is not None}),
        "deepest": deepest(found),
        "searched": found.searched,
        "seconds": seconds,
    }


def world_row(
    home: Path, meshes: Sequence[Path], size: int, known: bool, boxes: bool, processes: int
) -> dict[str, Any]:
    """What is found in one world."""
    world_said = json.loads((home / WORLD).read_text())
    catalog = read_catalog(meshes, part_of_world(world_said["seed"]), GIVEN)
    world = make_world(world_said["seed"], catalog)
    standing = [placed for placed in world.things if placed.model is not None]
    models: list[Model] = []
    for placed in standing:
        assert placed.model is not None
        if not any(_same(placed.model, other) for other in models):
            models.append(placed.model)
    rng = np.random.default_rng([world_said["seed"], 54])
    while len(models) < size:
        other = catalog.draw_big(rng) if rng.random() < 0.5 else catalog.draw_small(rng)
        if not any(_same(other, one) for one in models):
            models.append(other)
    fields = [MeshField(one.mesh.vertices, one.mesh.faces) for one in models]
    library = [
        LibraryObject(f"{one.name} {n}", partial(_itself, field), model_object(field))
        for n, (one, field) in enumerate(zip(models, fields, strict=True))
    ]
    scene, _ = room_field(home)
    options = RegistrationOptions(robust=RobustOptions(min_scale=0.97, max_scale=1.03) if known else RobustOptions())
    start = time.perf_counter()
    found = populate(scene, library, options, processes=processes)
    seconds = time.perf_counter() - start
    things = []
    for placed in standing:
        assert placed.model is not None
        number = next(n for n, one in enumerate(models) if _same(placed.model, one))
        symmetries = Symmetries.from_dict(measure_symmetries(placed.model)[0])
        case, T = _case_of(world_said, placed.model.name, placed.T_room_model)
        voxels = 0.0 if case is None else float(case["voxels_across"])
        points = torch.from_numpy(np.asarray(placed.model.surface)).double()
        things.append(Thing(number, points, Sim3.from_matrix(T), symmetries, placed.model.diameter, voxels))
    surfaces = [torch.from_numpy(np.asarray(one.surface)).double() for one in models]
    row = judged(found, surfaces, things, seconds) | {"scene": home.name, "library": len(library), "known": known}
    return row | ({"boxes": list(_with_boxes(home))} if boxes else {})


def _with_boxes(home: Path) -> Iterator[bool]:
    """Whether each large object of a case is found in its true box: what a perfect detector would give."""
    for one in cases_of(home):
        if one.facts["voxels_across"] < _LARGE or one.case.truth is None:
            continue
        result = register(one.case.scene, one.case.obj, one.case.detection, clouds=False)
        poses = [result.T_object_scene, *(other.T_object_scene for other in result.alternatives)]
        off = [surface_displacement(T, one.case.truth, one.points, one.case.symmetries) for T in poses]
        size = float(torch.pdist(one.points[:: max(1, len(one.points) // 400)]).max())
        size /= float(one.case.truth.scale)
        yield result.verdict != "rejected" and min(float(each.amax(1).min()) for each in off) <= _RIGHT * size


def _itself(field: MeshField) -> MeshField:
    return field


def _same(one: Model, other: Model) -> bool:
    a, b = one.mesh.vertices, other.mesh.vertices
    return one.name == other.name and a.shape == b.shape and bool(np.allclose(a, b))


def _case_of(world: dict[str, Any], name: str, T_room_model: Any) -> tuple[dict[str, Any] | None, Any]:
    """The case of a thing, and where the map shows it: drift moves it; the thing's own pose where it is no case."""
    best, nearest = None, 0.25
    for case in world["cases"]:
        T = np.linalg.inv(np.array(case["T_object_scene"]) @ np.array(world["T_scene_room"]))
        T = T @ np.array(case["T_object_model"])
        apart = float(np.linalg.norm(T[:3, 3] - T_room_model[:3, 3]))
        turned = float(np.abs(T[:3, :3] - T_room_model[:3, :3]).max())
        if case["name"] == name and apart < nearest and turned < 0.1:
            best, nearest = (case, T), apart
    return best if best is not None else (None, np.asarray(T_room_model))


def room_rows(fields: Path, processes: int) -> Iterator[dict[str, Any]]:
    """The paper's rooms, with a library of all of its objects, at any scale."""
    pairs = load_pairs(fields)
    names = sorted({one.object for one in pairs})
    library = [
        LibraryObject(name, partial(open_field, fields, name), model_object(open_field(fields, name))) for name in names
    ]
    surfaces = [one.model.frame.out_of(one.model.samples.on_surface()) for one in library]
    for room in sorted({one.room for one in pairs}):
        start = time.perf_counter()
        found = populate(open_field(fields, room), library, processes=processes)
        seconds = time.perf_counter() - start
        things = []
        for one in pairs:
            if one.room == room:
                number = names.index(one.object)
                T, own = one.truth.inverse(), one.case().symmetries
                things.append(Thing(number, surfaces[number], T, own, one.diameter, _LARGE))
        yield judged(found, surfaces, things, seconds) | {"scene": room, "library": len(library), "known": False}


_COLUMNS = (
    "scenes", "library", "scale", "things found", "large things found", "large, in true boxes", "placed", "wrong",
    "twice", "deepest, spacings", "seconds, median and most",
)  # fmt: skip


def report(rows: Sequence[dict[str, Any]]) -> str:
    """The rows as a table."""
    groups: dict[tuple[str, int, bool], list[dict[str, Any]]] = {}
    for row in rows:
        kind = parts_of_name(row["scene"])[0] if row["scene"].count("-") > 1 else "rooms of the paper"
        groups.setdefault((kind, row["library"], row["known"]), []).append(row)
    lines = [f"| {' | '.join(_COLUMNS)} |", "|" + "---|" * len(_COLUMNS)]
    for (kind, size, known), some in groups.items():
        total = {name: sum(row[name] for row in some) for name in ("found", "things", "large_found", "large")}
        boxes = [one for row in some for one in row.get("boxes", ())]
        seconds = sorted(row["seconds"] for row in some)
        cells = (
            f"{len(some)} {kind}", size, "known" if known else "free", f"{total['found']} of {total['things']}",
            f"{total['large_found']} of {total['large']}", f"{sum(boxes)} of {len(boxes)}" if boxes else "",
            sum(row["placed"] for row in some), sum(len(row["wrong"]) for row in some),
            sum(row["twice"] for row in some), f"{max(row['deepest'] for row in some):.1f}",
            f"{seconds[len(seconds) // 2]:.0f}, {seconds[-1]:.0f}",
        )  # fmt: skip
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=("worlds", "rooms", "report"))
    parser.add_argument("source", type=Path)
    parser.add_argument("--meshes", type=Path, nargs="+", default=[])
    parser.add_argument("--part", default="test")
    parser.add_argument("--scene", default="rendered")
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--library", type=int, default=50)
    parser.add_argument("--free-scale", action="store_true")
    parser.add_argument("--boxes", action="store_true", help="also register each case in its true box")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--output", type=Path)
    said = parser.parse_args()
    torch.set_num_threads(1)
    if said.command == "report":
        text = report([json.loads(line) for line in said.source.read_text().splitlines()])
        (said.output.write_text if said.output else sys.stdout.write)(text)
        return
    if said.command == "rooms":
        rows = room_rows(said.source, said.processes)
    else:
        homes = sorted(path.parent for path in said.source.glob(f"{said.scene}-*-long/{WORLD}"))
        homes = [home for home in homes if part_of_world(parts_of_name(home.name)[1]) == said.part]
        rows = (
            world_row(home, said.meshes, said.library, not said.free_scale, said.boxes, said.processes)
            for home in islice(homes, said.count)
        )
    with (said.output or Path(os.devnull)).open("a") as file:
        for row in rows:
            sys.stdout.write(json.dumps(row) + "\n")
            sys.stdout.flush()
            file.write(json.dumps(row) + "\n")
            file.flush()


if __name__ == "__main__":
    main()
