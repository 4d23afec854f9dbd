"""Registrations of things cut from one half with the map of the other, each judged by the truth."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from benchmarks.real.cases import Work, make_case, object_field
from benchmarks.real.drift import Overlap, overlap
from benchmarks.real.maps import open_map
from benchmarks.real.scenes import Thing
from benchmarks.real.stages import stages_of
from benchmarks.robust.cases import Case
from benchmarks.robust.judging import SUCCESS
from benchmarks.robust.runs import Job, Run, run_one
from regnf_core import RegistrationResult, SdfField

_SHOWN = 0.5
"""The share of a thing's surface that the other half must show; else nothing is asked of its registration but to be
rejected."""
_MISSING = float("inf")


@dataclass(frozen=True)
class Wanted:
    """Which registrations. maps, observations, kinds: of the constants in maps.py and objects.py · only: names of
    things, none for all · stages: whether to find out which stage loses the truth."""

    maps: Sequence[str]
    observations: Sequence[str]
    kinds: Sequence[str]
    seeds: Sequence[int]
    only: Sequence[str] = ()
    stages: bool = False


def register_all(work: Work, things: Sequence[Thing], wanted: Wanted) -> Iterator[Run]:
    """One run a map, observation, kind of object, thing and seed. What was not made is left out."""
    files = work.map_files("B")
    for kind_of_map in wanted.maps:
        if kind_of_map == "fit" and not files.fit.exists():
            continue
        for observed in wanted.observations:
            scene = open_map(files, kind_of_map, observed)
            for kind in wanted.kinds:
                facts = {"halves": work.halves.name, "map": kind_of_map, "observation": observed, "object": kind}
                for run in _register_kind(work, things, scene, kind, wanted):
                    yield facts | run


def _register_kind(work: Work, things: Sequence[Thing], scene: SdfField, kind: str, wanted: Wanted) -> Iterator[Run]:
    for number, thing in enumerate(things):
        if (wanted.only and thing.name not in wanted.only) or not work.object_file(thing, kind).exists():
            continue
        obj = object_field(work, thing, kind)
        common = overlap(work.map_files("A").fused, work.map_files("B").fused, thing)
        for seed in wanted.seeds:
            case = make_case(scene, obj, thing, number, seed)
            yield _register_one(case, thing, common, seed, wanted.stages)


def _register_one(case: Case, thing: Thing, common: Overlap, seed: int, with_stages: bool) -> Run:
    """The run with its errors, metric and in shares; with what the maps themselves have in common there."""

    def more(case: Case, result: RegistrationResult) -> Run:
        assert case.truth is not None
        found, size = result.T_object_scene, result.metrics["object_diameter"]
        center = result.object_samples.points.double().mean(0, keepdim=True)
        apart = found.inverse().apply(center) - case.truth.inverse().apply(center)
        return {
            "scale_ratio": float(found.scale / case.truth.scale),
            "center_error_share": float(apart.norm() * case.truth.scale) / size,
            "diameter_m": size / float(case.truth.scale),
        }

    run = run_one(Job(lambda: case, thing.name, seed), more)
    diameter = run.get("diameter_m", math.nan)
    allowed = SUCCESS + common.drift_m / diameter if diameter > 0.0 else SUCCESS
    found = {
        "right": run.get("mssd_share", _MISSING) <= SUCCESS,
        "right_within_drift": run.get("mssd_share", _MISSING) <= allowed,
        "accepted": run["verdict"] in ("registered", "ambiguous"),
        "drift_m": common.drift_m,
        "seen_share": common.seen_share,
        "shown": common.seen_share >= _SHOWN,
    }
    return run | found | (stages_of(case, seed) if with_stages else {})
