"""Which of many objects a detection shows: cheap tests for all of them, dear ones for the few that pass.

Signatures rank the whole library, a coarse search on the samples ranks the best of those, and the last few are refined
on their fields and judged as in a registration. The scene is sampled once, and only the last few fields are opened.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from regnf_core.fields.base import SdfField
from regnf_core.fields.counting import CountingField
from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import RegistrationOptions
from regnf_core.robust.model.object_model import ObjectModel
from regnf_core.robust.model.signature import signature
from regnf_core.robust.pipeline import (
    Outcome,
    Problem,
    find_candidates,
    pose_problem,
    refine_candidates,
    start_rotations,
)
from regnf_core.robust.scene.scene_view import SceneView
from regnf_core.robust.search.search import Round
from regnf_core.robust.verdict.conclusion import Conclusion, conclude

_SHORTLIST = 12
"""Objects searched coarsely. With 64 objects the right one was never farther down than 7th by its signature."""
_FINALISTS = 4
_MARGIN = 0.15  # of the coarse score: objects farther behind the best one are no finalists
_ROTATION_SHARE = 2.5  # rotations of a registration for each of the coarse search
_ROUNDS = (
    Round(points=48, widths=(), score_width=0.10, keep=120, apart=0.0),
    Round(points=64, widths=(0.15, 0.12, 0.10, 0.08), score_width=0.06, keep=30, apart=0.05),
    Round(points=128, widths=(0.08, 0.06, 0.05, 0.04), score_width=0.04, keep=8, apart=0.05),
)
_MOST_APART = 4.0  # squared distance of two signatures that share no bin


@dataclass(frozen=True, eq=False)
class Finalist:
    """An object refined on its field. number: its place in the library · evaluations: of both fields."""

    number: int
    problem: Problem
    outcome: Outcome
    conclusion: Conclusion
    evaluations: int


@dataclass(frozen=True, eq=False)
class Contender:
    """An object after the coarse search. score: of its best pose, 0..1, smaller is better · poses (H,), best first."""

    number: int
    score: float
    poses: Sim3


def by_signature(view: SceneView, models: Sequence[ObjectModel]) -> list[tuple[int, float]]:
    """Number of each model and its distance to the view by signature (0..1), nearest first."""
    own = signature(view.foreground)
    apart = torch.stack([(model.signature - own).square().sum() / _MOST_APART for model in models])
    order: list[int] = apart.argsort(stable=True).tolist()
    return [(number, float(apart[number])) for number in order]


def coarsely(
    view: SceneView, models: Sequence[ObjectModel], nearest: Sequence[int], options: RegistrationOptions, seed: int
) -> list[Contender]:
    """The nearest models after a coarse search on the samples, best first."""
    rotations = start_rotations(options, _ROTATION_SHARE)
    found = []
    for number in nearest[:_SHORTLIST]:
        generator = torch.Generator().manual_seed(seed)
        T, scores = find_candidates(view, models[number], rotations, generator, rounds=_ROUNDS)
        found.append(Contender(number, float(scores[0]), T))
    return sorted(found, key=lambda one: one.score)


def still_in(contenders: Sequence[Contender]) -> list[Contender]:
    """Those that may yet win."""
    return [one for one in contenders if one.score <= contenders[0].score + _MARGIN][:_FINALISTS]


def refine_contender(
    scene: SdfField,
    view: SceneView,
    obj: SdfField,
    model: ObjectModel,
    contender: Contender,
    options: RegistrationOptions,
    seed: int,
    on_step: Callable[[], None],
) -> Finalist:
    """Refine the poses of one contender on the fields, and conclude. Raises InvalidInputError (FIELD_NOT_FINITE)."""
    counted_scene, counted_object = CountingField(scene), CountingField(obj)
    generator = torch.Generator().manual_seed(seed)
    problem = pose_problem(view, model, counted_scene, counted_object, options.robust, generator)
    outcome = refine_candidates(problem, contender.poses, options.robust, generator, on_step)
    conclusion = conclude(problem, outcome, options)
    return Finalist(
        contender.number, problem, outcome, conclusion, counted_scene.evaluations + counted_object.evaluations
    )
