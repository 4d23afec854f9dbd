"""Table 7: what is said of symmetric objects, against their true groups."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from benchmarks.robust.cases import KINDS, Case, load_pairs
from benchmarks.robust.judging import SUCCESS
from benchmarks.robust.report import Bar, Section, Table, by_group, failures_of
from benchmarks.robust.runs import Context, Job, Run, run_all
from benchmarks.robust.symmetries import ANY_TURN, TURNS, nearly
from benchmarks.symmetric_errors import Symmetries, mssd
from regnf_core import RegistrationResult, Sim3

NAME = "symmetry"
SEEDS = 3
OBJECTS = (*TURNS, *ANY_TURN, "ycb_004_sugar_box", "boombox")


def table(context: Context) -> Table:
    """Tables, a can, a vase, a box: poses listed, poses missing, and poses that are no symmetry."""
    pairs = [pair for file in KINDS.values() for pair in load_pairs(context.folder, file)]
    names = {pair.name: pair.instance for pair in pairs if pair.instance in OBJECTS}
    jobs = [Job(pair.case, pair.name, seed) for pair in pairs if pair.name in names for seed in range(SEEDS)]

    def measure(case: Case, result: RegistrationResult) -> dict[str, Any]:
        return explain(case, result, nearly(names[case.name]))

    runs = run_all(jobs, context, measure)
    exact = [run for run in runs if names[run["case"]] in (*TURNS, *ANY_TURN)]
    complete = [run for run in exact if run.get("missing") == 0 and run.get("foreign") == 0]
    return Table(
        NAME,
        "Symmetric objects",
        [
            Bar(
                "every twin listed and nothing else (objects with an exact symmetry)",
                f"{len(complete)}/{len(exact)}",
                bool(exact) and len(complete) == len(exact),
            )
        ],
        [
            Section(
                "Listed: the pose and its alternatives. Twins: what the true group asks for beside the pose; a free "
                "axis counts as complete when the alternatives say so. Near twins: poses that nearly carry the object "
                "onto itself. Foreign: neither.",
                ("pair", "true group", "verdicts", "listed", "twins missing", "near twins", "foreign", "relations"),
                [_row(name, names[name], some) for name, some in by_group(runs).items()],
            )
        ],
        runs,
        failures_of(runs),
    )


def explain(case: Case, result: RegistrationResult, near: Sequence[Sim3]) -> dict[str, Any]:
    """How the listed poses compare with the true ones: numbers of each kind, and the relations reported."""
    assert case.truth is not None
    points = result.object_samples.points.double()
    tolerance = SUCCESS * result.metrics["object_diameter"]
    poses = [result.T_object_scene, *(other.T_object_scene for other in result.alternatives)]
    relations = [other.relation for other in result.alternatives]
    truths = _all_true(case)
    near_truths = [one @ truth for one in near for truth in truths]
    true = [_meets(pose, truths, points, tolerance) for pose in poses]
    nearly_true = [_meets(pose, near_truths, points, tolerance) and not t for pose, t in zip(poses, true, strict=True)]
    if case.symmetries.continuous:
        missing = 0 if any("any turn" in relation for relation in relations) else 1
    else:
        missing = sum(not _meets(truth, poses, points, tolerance) for truth in truths)
    return {
        "missing": missing,
        "near": sum(nearly_true),
        "foreign": len(poses) - sum(true) - sum(nearly_true),
        "relations": relations,
    }


def _all_true(case: Case) -> list[Sim3]:
    assert case.truth is not None
    S = case.symmetries.transforms()
    return [Sim3(S.scale[k], S.rotation[k], S.translation[k]) @ case.truth for k in range(S.scale.shape[0])]


def _meets(pose: Sim3, others: Sequence[Sim3], points: Tensor, tolerance: float) -> bool:
    some = points[torch.linspace(0, len(points) - 1, 200).long()]
    return any(mssd(pose, other, some, Symmetries()) <= tolerance for other in others)


def _row(name: str, instance: str, runs: Sequence[Run]) -> list[str]:
    order = "any turn about z" if instance in ANY_TURN else f"{TURNS.get(instance, 1)}-fold about z"
    order += f", nearly {len(nearly(instance))} more" if nearly(instance) else ""
    # Which turns stand for a whole axis is a matter of chance.
    said = {relation for run in runs for relation in run.get("relations", [])}
    relations = sorted({re.sub(r"^-?\d+ degrees (.*any turn)", r"turns \1", relation) for relation in said})
    return [
        name,
        order,
        ", ".join(sorted({run["verdict"] for run in runs})),
        *(_spread([run.get(key) for run in runs]) for key in ("poses", "missing", "near", "foreign")),
        "; ".join(relations) or "none",
    ]


def _spread(values: Sequence[int | None]) -> str:
    known = sorted({value for value in values if value is not None})
    return " or ".join(str(value) for value in known)
