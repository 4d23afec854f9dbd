"""Table 5: scenes of which one depth image is all that was ever seen."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.robust.cases import Case, Pair, exact_surface, load_pairs
from benchmarks.robust.depth_camera import DepthCamera, noisy
from benchmarks.robust.judging import AMONG, NOT_AMONG, REJECTED, RIGHT, SUCCESSES, WRONG
from benchmarks.robust.one_view_compared import compared
from benchmarks.robust.one_view_field import Array, OneViewField
from benchmarks.robust.report import Bar, Section, Table, by_group, count, failures_of, median, share_bar, successes
from benchmarks.robust.runs import Context, Job, Run, run_all
from regnf_core import RegistrationResult
from scripts.make_demo_fields import SCENE_FRAME

NAME = "one_view"
AZIMUTHS = tuple(math.radians(20.0 + 72.0 * k) for k in range(5))
EYE_M, DISTANCE_M, WALL_M, FAR_M, NOISE_M = 1.6, 2.2, -2.3, 8.0, 0.01
"""Height of the camera, its distance along the floor, how near it comes to the two walls (x and y), meters."""
_RIGHT_GROUPS = {False: "exact depth", True: "depth with 1 cm noise"}
_HIDDEN = 0.015
"""Object diameters within matter from which a point counts as hidden."""
_SHARES = (0.0, 0.4, 0.5, 0.6, 0.7, 1.0)


def table(context: Context) -> Table:
    """Every main pair from five sides; and the armchair with and without its cushion taken for each other."""
    runs = run_all(list(_jobs(context)), context, _hidden_share)
    right = [run for run in runs if run["group"] in _RIGHT_GROUPS.values()]
    wrong = [run for run in runs if run not in right]
    both, searches = compared(context, seen_once, len(AZIMUTHS), _RIGHT_GROUPS)
    taken = [run for run in runs if run["category"] == WRONG]
    return Table(
        NAME,
        "One view",
        [
            share_bar("registered, or ambiguous with the truth: at least 85 %", successes(right), len(right), 0.85),
            Bar("none registered wrong", f"{len(taken)} of {len(runs)}", not taken),
            share_bar("of both chairs, the right one first: all", _first(searches), len(searches), 1.0),
        ],
        [
            Section("By the noise.", _HEAD, [_row(name, some) for name, some in by_group(right).items()]),
            Section(
                "By the share of the object's surface that lies more than 1.5 % of its diameter within what the camera "
                "did not see through, at the true pose.",
                _HEAD,
                [
                    _row(f"{100 * low:.0f} to {100 * high:.0f} % hidden", some)
                    for low, high in pairwise(_SHARES)
                    if (some := [run for run in right if low <= run.get("hidden_truly", -1.0) < high])
                ],
            ),
            Section("By the object.", _HEAD, [_row(name, some) for name, some in by_group(right, "pair").items()]),
            Section(
                "The chair like it in the box.", _HEAD, [_row(name, some) for name, some in by_group(wrong).items()]
            ),
            both,
        ],
        [*runs, *searches],
        failures_of(right)
        + [run for run in wrong if run["category"] != REJECTED]
        + [run for run in searches if run["place"] != 1],
        notes=[
            f"The camera stands {EYE_M:g} m above the floor, {DISTANCE_M:g} m from the object or as far as the walls "
            "allow, and sees 60 degrees across in 400 pixels. Everything behind what it sees is solid: the exact "
            "distance to the surface of triangles between neighboring pixels. Noise is alike in neighboring pixels. "
            "The objects are fitted fields."
        ],
    )


def _first(searches: list[Run]) -> int:
    return sum(run["place"] == 1 for run in searches)


_HEAD = (
    "",
    RIGHT,
    AMONG,
    "rejected or failed",
    NOT_AMONG,
    WRONG,
    "MSSD % median of the successes",
    "hidden % median",
    "seconds",
)


def _row(name: str, runs: list[Run]) -> list[str]:
    lost = sum(run["category"] not in (RIGHT, AMONG, NOT_AMONG, WRONG) for run in runs)
    good = [run for run in runs if run["category"] in SUCCESSES]
    return [
        name,
        str(count(runs, RIGHT)),
        str(count(runs, AMONG)),
        str(lost),
        str(count(runs, NOT_AMONG)),
        str(count(runs, WRONG)),
        f"{100 * median(good, 'mssd_share'):.2f}",
        f"{100 * median(runs, 'hidden_truly'):.0f}",
        f"{median(runs, 'seconds'):.1f}",
    ]


def _jobs(context: Context) -> Iterator[Job]:
    pairs = load_pairs(context.folder)
    for noise, group in _RIGHT_GROUPS.items():
        for pair in pairs:
            for view in range(len(AZIMUTHS)):
                yield Job(partial(seen_once, pair, view, noise), group)
    for shown, other in (("fc-nop", "fc"), ("fc", "fc-nop")):
        for pair in pairs:
            for view in range(len(AZIMUTHS)) if pair.instance == shown else ():
                for noise, how in _RIGHT_GROUPS.items():
                    yield Job(partial(seen_once, pair, view, noise, other), f"{other} looked for in {shown}: {how}")


def seen_once(pair: Pair, view: int, noise: bool, other: str | None = None) -> Case:
    """The pair, its scene known from one depth image; ``other`` is looked for instead of the right object."""
    case = pair.case() if other is None else pair.with_other(other)
    middle = pair.detection.center.numpy()
    image = _camera(pair.folder, pair.room).look(camera_position(middle, AZIMUTHS[view]), middle)
    if noise:
        image = noisy(image, NOISE_M * SCENE_FRAME.units_per_meter, seed=view)
    scene = OneViewField(image, case.scene.bounds)
    return replace(case, name=f"{case.name} view {view}", scene=scene)


def camera_position(middle: Array, azimuth: float) -> Array:
    """Where the camera stands, scene frame; ``middle`` (3,) is what it looks at."""
    unit = SCENE_FRAME.units_per_meter
    direction = np.array([math.cos(azimuth), math.sin(azimuth)])
    limits = SCENE_FRAME.points(np.array([[WALL_M, WALL_M, EYE_M]]))[0]
    room = [(limits[k] - middle[k]) / direction[k] for k in range(2) if direction[k] < 0.0]
    distance = min(DISTANCE_M * unit, *room) if room else DISTANCE_M * unit
    return np.array([*(middle[:2] + distance * direction), limits[2]])


@cache
def _camera(folder: Path, room: str) -> DepthCamera:
    return DepthCamera(*exact_surface(folder, room), far=FAR_M * SCENE_FRAME.units_per_meter)


def _hidden_share(case: Case, result: RegistrationResult) -> dict[str, Any]:
    pair = case.name.rsplit(" view ", 1)[0]
    if case.truth is None:
        return {"pair": pair}
    points = result.object_samples.points.double()
    distance = case.scene.signed_distance(case.truth.inverse().apply(points).float())
    depth = -distance * float(case.truth.scale) / result.metrics["object_diameter"]
    return {"pair": pair, "hidden_truly": float((depth > _HIDDEN).float().mean())}
