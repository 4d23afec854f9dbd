"""Poses with what the held-out samples tell of them, and whether they are right: what the verdict's model learns from,
and what its figures are of.

For every case of a world: the poses that registrations of the right object and of wrong ones chose among (`questions`),
and the best pose that a refinement from the truth leads to.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from benchmarks.random_worlds.models import part_of_world
from benchmarks.worlds.cases import ObservedBy, WorldCase, cases_of
from benchmarks.worlds.questions import ALTERED, KINDS, Kind, Question, ask
from benchmarks.worlds.recipe import parts_of_name
from benchmarks.worlds.stages import Recording, recorded
from benchmarks.worlds.trust import is_right
from regnf_core import OrientedBox, RegistrationOptions, RegnfError
from regnf_core.fields.observation import SdfField
from regnf_core.options import RobustOptions
from regnf_core.progress import Run
from regnf_core.robust import pipeline
from regnf_core.robust.model import ObjectModel, model_object
from regnf_core.robust.problem import RegistrationProblem
from regnf_core.robust.refine.pose_candidates import PoseCandidates
from regnf_core.robust.scene import SceneView, view_scene
from regnf_core.robust.verdict.answer import Relations, choose
from regnf_core.robust.verdict.comparison import Placed, compare
from regnf_core.robust.verdict.evaluation import held_out_of
from regnf_core.version import ENGINE_REVISION

Row = dict[str, Any]
_OPTIONS = RegistrationOptions(preset="robust")


@dataclass(frozen=True)
class Gathering:
    """by: what tells what was seen of the scenes · cases: of each world, at most, the first ones · kinds: of questions
    about each case · others: how many wrong questions a case has, drawn from the kinds; None: all of them · truth: add
    the poses that refinements from the truth lead to · known_scale: the right object's scale is said to lie within this
    share of the true one; None: nothing is said."""

    by: ObservedBy = "images"
    cases: int = 8
    kinds: tuple[Kind, ...] = KINDS
    others: int | None = None
    truth: bool = True
    seed: int = 0
    known_scale: float | None = None


def evidence_of_world(home: Path, known: Sequence[Path], gathering: Gathering) -> list[Row]:
    """The rows of a world's folder. known: all folders; wrong objects come from the other worlds of its part."""
    others = [
        one for one in known if _seed(one) != _seed(home) and part_of_world(_seed(one)) == part_of_world(_seed(home))
    ]
    rows: list[Row] = []
    cases = list(cases_of(home, gathering.by))
    for number in range(min(len(cases), gathering.cases)):
        made = _Made()
        for kind in _kinds(gathering, home, number):
            question = ask(kind, home, cases, number, others)
            options = _options(gathering, cases[number])
            if question is not None:
                facts = {"revision": ENGINE_REVISION, **cases[number].facts, "question": kind, "seed": gathering.seed}
                facts["known_scale"] = gathering.known_scale
                facts["model"] = question.asked.facts["object"]
                rows += [{**facts, **row} for row in _rows(question, options, gathering, made)]
    return rows


def _options(gathering: Gathering, known: WorldCase) -> RegistrationOptions:
    truth = known.case.truth
    assert truth is not None
    if gathering.known_scale is None:
        return _OPTIONS
    low, high = (float(truth.scale) * (1.0 + side * gathering.known_scale) for side in (-1.0, 1.0))
    return RegistrationOptions(preset="robust", robust=RobustOptions(min_scale=low, max_scale=high))


def _kinds(gathering: Gathering, home: Path, number: int) -> list[Kind]:
    wrong = [kind for kind in gathering.kinds if kind != "right"]
    if gathering.others is not None:
        draw = torch.Generator().manual_seed(sum(home.name.encode()) * 64 + number)
        wrong = [wrong[one] for one in torch.randperm(len(wrong), generator=draw)[: gathering.others].tolist()]
    return (["right"] if "right" in gathering.kinds else []) + wrong


def _seed(home: Path) -> int:
    return parts_of_name(home.name)[1]


class _Made:
    """Views of boxes and models of objects that several questions share."""

    def __init__(self) -> None:
        self._views: list[tuple[OrientedBox, SceneView]] = []
        self._models: list[tuple[SdfField, ObjectModel]] = []
        self._right: Placed | None = None

    def view(self, scene: SdfField, box: OrientedBox) -> SceneView:
        found = next((view for known, view in self._views if known is box), None)
        if found is None:
            found = view_scene(scene, box, _OPTIONS.robust)
            self._views.append((box, found))
        return found

    def compared(self, question: Question, placed: Placed, right: bool) -> Row:
        """What tells an altered object from the right one, where that was found at a right pose before."""
        if question.kind == "right" and right:
            self._right = placed
        elif question.kind in ALTERED and self._right is not None:
            return {"difference": asdict(compare(self._right, placed).difference)}
        return {}

    def model(self, field: SdfField) -> ObjectModel:
        found = next((model for known, model in self._models if known is field), None)
        if found is None:
            found = model_object(field, _OPTIONS.robust)
            self._models = [*self._models[:1], (field, found)]  # the right object's, and the last one's
        return found


def _rows(question: Question, options: RegistrationOptions, gathering: Gathering, made: _Made) -> Iterator[Row]:
    """One row a pose."""
    case = question.asked.case
    with recorded() as kept:
        try:
            view, model = made.view(case.scene, case.detection), made.model(case.obj)
            result = pipeline.register_robust(
                case.scene, case.obj, case.detection, options, gathering.seed, Run(None), None, model, view
            )
        except RegnfError as error:
            nothing = {"mssd": 9.0, "listed_mssd": 9.0, "seen_difference": 1.0, "probability": 0.0, "features": {}}
            yield {"winner": True, "found": True, "verdict": "refused", "reason": error.reason, **nothing}
            return
    problem, last = kept.problem, kept.evaluations[-1]
    assert problem is not None
    assert last.candidates.offsets is not None
    rows = pose_rows(problem, last.candidates, question.errors(problem, last.candidates.T), last.winner)
    answer = rows[last.winner]
    differs, seen = question.seen_difference(problem, last.candidates.T[last.winner])
    told: Row = {"verdict": result.verdict, "reason": result.verdict_reason, "probability": result.probability}
    told |= made.compared(question, last.placed(problem.on("cpu")), is_right(answer))
    answer |= {**told, "differs": round(differs, 4), "seen_difference": round(seen, 4)}
    yield from rows
    if question.kind == "right" and gathering.truth:
        refined = _from_truth(kept, question)
        yield from pose_rows(problem, refined, question.errors(problem, refined.T), None)


def _from_truth(kept: Recording, question: Question) -> PoseCandidates:
    problem, truth = kept.problem, question.known.case.truth
    assert problem is not None
    assert truth is not None
    start = problem.in_working_frames(truth)[None]
    return pipeline.refine_poses(problem, start, torch.Generator().manual_seed(0))[torch.tensor([0])]


def pose_rows(
    problem: RegistrationProblem,
    candidates: PoseCandidates,
    errors: Sequence[float],
    winner: int | None,
    options: RegistrationOptions = _OPTIONS,
) -> list[Row]:
    """Rows of these candidates. errors: (H,) · winner: the chosen one's number.

    A row's ``others`` are the candidates that are other answers, by how many rows they stand after it.
    ``moved`` and ``same``: how far each candidate places the object from this one, diameters, and the share of its
    surface that comes to lie on its own · ``found``: it is one of a registration's candidates.
    """
    held_out = held_out_of(problem, candidates, options)
    problem, candidates = problem.on("cpu"), candidates.on("cpu")
    features, scores = held_out.features, held_out.evidence.numbers["score"]
    poses = Relations.of(problem.model, candidates.T)
    rivals = choose(problem, candidates, features, scores, options.robust.rival_margin).rivals
    count = range(len(candidates))
    return [
        {
            "mssd": round(errors[number], 4),
            "listed_mssd": round(min(errors[one] for one in (number, *rivals)), 4),
            "rivals": len(rivals),
            "winner": number == winner,
            "found": winner is not None,
            "others": (poses.apart[number].nonzero()[:, 0] - number).tolist(),
            "moved": [round(one, 3) for one in poses.moved[number].tolist()],
            "same": [1.0 if one == number else round(poses.same(one, number), 2) for one in count],
            "score": round(float(scores[number]), 5),
            "features": {name: round(float(values[number]), 5) for name, values in features.items()},
        }
        for number in count
    ]
