"""Table 3: scenes and objects in any orientation."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from benchmarks.robust.cases import KINDS, Case, Pair, exact_surface, load_pairs
from benchmarks.robust.report import Table, accuracy_section, failures_of, share_bar, successes
from benchmarks.robust.runs import Context, Job, run_all
from benchmarks.robust.symmetries import turn
from regnf_core import OrientedBox, Sim3

NAME = "orientations"
RANDOM = 20
PAIRS_EACH = 5
"""Pairs for each orientation: the first five for the first one, the next five for the next, and so round all."""


def table(context: Context) -> Table:
    """Lying, upside down and random orientations; the box turned with the scene, or axis-aligned in it."""
    pairs = [pair for file in KINDS.values() for pair in load_pairs(context.folder, file)]
    jobs = []
    for number, name in enumerate(orientations()):
        for k in range(min(PAIRS_EACH, len(pairs))):
            pair = pairs[(PAIRS_EACH * number + k) % len(pairs)]
            aligned = (number + k) % 2 == 1
            group = "axis-aligned box" if aligned else "box turned with the scene"
            jobs.append(Job(partial(turned, pair, name, aligned), group))
    runs = run_all(jobs, context)
    return Table(
        NAME,
        "Any orientation of scene and object",
        [share_bar("at least 99 %", successes(runs), len(runs), 0.99)],
        [
            accuracy_section(
                f"Lying, upside down and {RANDOM} random orientations of the scene, the object's frame turned at "
                f"random as well; no up axis given; {PAIRS_EACH} of the pairs, main and held out, for each one.",
                "box",
                runs,
            )
        ],
        runs,
        failures_of(runs),
    )


def orientations() -> dict[str, Sim3]:
    """Turns of the scene, by name."""
    generator = torch.Generator().manual_seed(3)
    found = {"lying": turn((1.0, 0.0, 0.0), 90.0), "upside down": turn((1.0, 0.0, 0.0), 180.0)}
    for number in range(RANDOM):
        found[f"random {number}"] = random_turn(generator)
    return found


def random_turn(generator: torch.Generator) -> Sim3:
    """A rotation drawn evenly from all."""
    quaternion = torch.randn(4, generator=generator, dtype=torch.float64)
    return Sim3.from_quaternion(1.0, quaternion, [0.0, 0.0, 0.0])


def turned(pair: Pair, name: str, aligned: bool) -> Case:
    """The pair in a turned scene, with the object's frame turned as well."""
    names = list(orientations())
    T_new_scene = orientations()[name]
    T_new_object = random_turn(torch.Generator().manual_seed(100 + names.index(name)))
    case = pair.case().seen_in(T_new_scene, T_new_object)
    if aligned:
        case = case.in_box(aligned_box(T_new_scene.apply(vertices_within(pair))))
    return replace(case, name=f"{pair.name} {name}")


def aligned_box(points: Tensor) -> OrientedBox:
    """The axis-aligned box round points (N, 3)."""
    return OrientedBox.from_corners(points.amin(0).tolist(), points.amax(0).tolist())


def vertices_within(pair: Pair) -> Tensor:
    """The scene's exact vertices (N, 3) within the detection: the object's own, scene frame."""
    vertices = torch.from_numpy(exact_surface(pair.folder, pair.room)[0].astype(np.float64))
    return vertices[pair.detection.contains(vertices, 1e-5)]
