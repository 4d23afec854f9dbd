"""Poses with what the held-out samples tell of them, and whether they are right: what the verdict's model learns from.

For every case of a world: the poses that a registration chose among, the best pose that a refinement from the truth
leads to, and, for other objects registered in the same box, the poses that they chose among, which are all wrong: one
of another world, a look-alike of the right one, and, where it is asked for, one of a similar shape.
"""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from benchmarks.random_worlds.models import part_of_world
from benchmarks.worlds.cases import ObservedBy, WorldCase, cases_of
from benchmarks.worlds.look_alikes import LOOK_ALIKE, look_alike
from benchmarks.worlds.recipe import parts_of_name
from benchmarks.worlds.similar_objects import similar_object
from benchmarks.worlds.stages import NearestTruth, Recording, recorded
from regnf_core import RegistrationOptions, RegnfError, Sim3, register
from regnf_core.geometry.metrics import NearestNeighbors, diameter
from regnf_core.robust import pipeline
from regnf_core.robust.problem import RegistrationProblem
from regnf_core.robust.refine.pose_candidates import PoseCandidates
from regnf_core.robust.verdict.answer import apart, choose
from regnf_core.robust.verdict.evaluation import held_out_of

Row = dict[str, Any]
Asked = Literal["right", "other", "look-alike", "similar"]
ASKED: tuple[Asked, ...] = ("right", "other", "look-alike", "similar")
"""Whose pose is looked for in a case's box: the right object's, that of one of another kind, of one that differs from
the right one by a part, of one of a similar shape."""
TRAINED: tuple[Asked, ...] = ("right", "other", "look-alike")
"""What the rows of a model were made of, in this order."""
_OPTIONS = RegistrationOptions(preset="robust")
_POINTS = 4000
_SAME_SHAPE = 0.03
"""Diameters. An object whose surface lies that close to the right one's, nearly everywhere, is no wrong object."""


@dataclass(frozen=True)
class Gathering:
    """by: what tells what was seen of the scenes · cases: of each world, at most, the first ones · asked: the objects
    that are looked for in each case's box · look_alikes_every: of so many cases the first has a look-alike."""

    by: ObservedBy = "images"
    cases: int = 8
    asked: tuple[Asked, ...] = TRAINED
    look_alikes_every: int = 1


def evidence_of_world(home: Path, known: Sequence[Path], gathering: Gathering) -> list[Row]:
    """The rows of a world's folder. known: all folders; wrong objects come from the other worlds of its part."""
    draw = random.Random(home.name)
    others = [
        one for one in known if _seed(one) != _seed(home) and part_of_world(_seed(one)) == part_of_world(_seed(home))
    ]
    rows: list[Row] = []
    for number, case in enumerate(list(cases_of(home, gathering.by))[: gathering.cases]):
        for asked in gathering.asked:
            if asked == "look-alike" and number % gathering.look_alikes_every:
                continue
            model = _asked(asked, home, case, others, draw)
            if model is not None:
                rows += [{**case.facts, "model": model.facts["object"], **row} for row in _rows(case, model)]
    return rows


def _asked(asked: Asked, home: Path, case: WorldCase, others: Sequence[Path], draw: random.Random) -> WorldCase | None:
    """The case whose object is looked for in the box of ``case``; None where there is none."""
    if asked == "right":
        return case
    if asked == "other":
        return _another(case, others, draw)
    rng = np.random.default_rng(draw.getrandbits(32))
    return look_alike(home, case, rng) if asked == "look-alike" else similar_object(home, case, others, rng)


def _seed(home: Path) -> int:
    return parts_of_name(home.name)[1]


def _another(known: WorldCase, others: Sequence[Path], draw: random.Random) -> WorldCase | None:
    """A case with an object of another name, from one of the other worlds."""
    if not others:
        return None
    kind = known.facts["object"].split("_")[0]
    found = [one for one in cases_of(draw.choice(others)) if one.facts["object"].split("_")[0] != kind]
    return draw.choice(found) if found else None


def _rows(known: WorldCase, asked: WorldCase) -> Iterator[Row]:
    """One row a pose. known: the case that the box is of · asked: the one whose object is looked for in it."""
    with recorded() as kept:
        try:
            result = register(known.case.scene, asked.case.obj, known.case.detection, _OPTIONS, clouds=False)
        except RegnfError:
            return
    other = asked is not known and asked.facts["object"] != LOOK_ALIKE
    if kept.problem is None or (other and _same_shape(known, asked, result.T_object_scene)):
        return
    last = kept.evaluations[-1]
    found = _described(kept.problem, last.candidates, known if asked is known else None, last.winner)
    yield from ({**row, "verdict": result.verdict} for row in found)
    if asked is known:
        yield from ({**row, "found": False} for row in _described(kept.problem, _from_truth(kept, known), known, None))


def _from_truth(kept: Recording, known: WorldCase) -> PoseCandidates:
    problem = kept.problem
    assert problem is not None
    assert known.case.truth is not None
    start = problem.in_working_frames(known.case.truth)[None]
    return pipeline.refine_poses(problem, start, torch.Generator().manual_seed(0))[torch.tensor([0])]


def _described(
    problem: RegistrationProblem, candidates: PoseCandidates, known: WorldCase | None, winner: int | None
) -> Iterator[Row]:
    """Rows of these candidates. known: what they should be; None: all are wrong · winner: the chosen one's number.

    A row's ``others`` are the candidates that are other answers, by how many rows they stand after it.
    ``found``: it is one of a registration's candidates.
    """
    held_out = held_out_of(problem, candidates, _OPTIONS)
    features, evidence = held_out.features, held_out.evidence
    errors = _errors(problem, candidates.T, known)
    elsewhere = apart(candidates.T, problem.model.extremal_points, problem.model.symmetry)
    rivals = choose(problem, candidates, features, evidence.numbers["score"], _OPTIONS.robust.rival_margin).rivals
    for number in range(len(candidates)):
        yield {
            "mssd": errors[number],
            "listed_mssd": min(errors[one] for one in (number, *rivals)),
            "rivals": len(rivals),
            "winner": number == winner,
            "found": True,
            "others": (elsewhere[number].nonzero()[:, 0] - number).tolist(),
            "score": float(evidence.numbers["score"][number]),
            "features": {name: float(values[number]) for name, values in features.items()},
        }


def _errors(problem: RegistrationProblem, T: Sim3, known: WorldCase | None) -> list[float]:
    """MSSD of each pose, diameters; of a wrong object 9."""
    if known is None or known.case.truth is None:
        return [9.0] * len(T)
    found: list[float] = NearestTruth(problem, known.case.truth, known.points, known.case.symmetries).errors(T).tolist()
    return found


def _same_shape(known: WorldCase, asked: WorldCase, T: Sim3) -> bool:
    """Whether the object that was asked for coincides with the right one where it was found."""
    assert known.case.truth is not None
    there = known.case.truth.inverse().apply(known.points[:_POINTS].double()).float()
    found = T.inverse().apply(asked.points[:_POINTS].double()).float()
    far = [NearestNeighbors(one).query(other)[0].quantile(0.95) for one, other in ((there, found), (found, there))]
    return float(max(far)) <= _SAME_SHAPE * diameter(there)
