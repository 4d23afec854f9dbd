"""Which of many objects a detection shows: fast tests for all of them, slow ones for the few that pass.

Signatures rank the whole library, a coarse search on the samples ranks the best of those, and the last few are refined
on their fields and evaluated as in a registration. The scene is sampled once, and only the last few fields are opened.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from regnf_core.fields.observation import CountingField, SdfField
from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import RegistrationOptions
from regnf_core.robust.constants import LIBRARY
from regnf_core.robust.model import ObjectModel, signature
from regnf_core.robust.pipeline import geometric_seeds, refine_poses, search_poses
from regnf_core.robust.problem import RegistrationProblem, make_problem, pose_bound
from regnf_core.robust.scene import SceneView
from regnf_core.robust.search.bounds import start_rotations
from regnf_core.robust.verdict.evaluation import Evaluation, evaluate_candidates
from regnf_core.robust.working_frame import working_device

_MAX_SQUARED_DISTANCE = 4.0  # of two signatures without a common bin


@dataclass(frozen=True, eq=False)
class CoarseMatch:
    """An object after the coarse search. number: its place in the library · score: of its best pose, 0..1, smaller is
    better · poses: (H,), best first."""

    number: int
    score: float
    poses: Sim3


@dataclass(frozen=True, eq=False)
class RefinedMatch:
    """An object refined on its field. number: its place in the library · field_evaluations: of both fields."""

    number: int
    problem: RegistrationProblem
    evaluation: Evaluation
    field_evaluations: int


@dataclass(frozen=True, eq=False)
class LibraryQuery:
    """What the library is searched for: a view of a scene, with its field, by these options and this seed."""

    scene: SdfField
    view: SceneView
    options: RegistrationOptions
    seed: int


def rank_by_signature(view: SceneView, models: Sequence[ObjectModel]) -> list[tuple[int, float]]:
    """Number of each model and its distance to the view by signature (0..1), nearest first."""
    own = signature(view.foreground)
    apart = torch.stack([(model.signature - own).square().sum() / _MAX_SQUARED_DISTANCE for model in models])
    order: list[int] = apart.argsort(stable=True).tolist()
    return [(number, float(apart[number])) for number in order]


def match_coarsely(query: LibraryQuery, models: Sequence[ObjectModel], nearest: Sequence[int]) -> list[CoarseMatch]:
    """The nearest models after a coarse search on the samples, best first."""
    rotations = start_rotations(query.options, LIBRARY.rotations_divisor)
    device = working_device(query.scene)
    view, found = query.view.to(device), []
    for number in nearest[: LIBRARY.shortlist]:
        generator = torch.Generator().manual_seed(query.seed)
        model = models[number].to(device)
        bound = pose_bound(view, model, query.options.robust)
        seeds = geometric_seeds(view, model, rotations, bound.scale)
        candidates = search_poses(view, model, seeds, generator, bound, LIBRARY.stages)
        found.append(CoarseMatch(number, float(candidates.scores[0]), candidates.T))
    return sorted(found, key=lambda one: one.score)


def worth_refining(matches: Sequence[CoarseMatch]) -> list[CoarseMatch]:
    """Those of the coarse matches, best first, that may still be the right object."""
    return [one for one in matches if one.score <= matches[0].score + LIBRARY.margin][: LIBRARY.max_refined]


def refine_match(
    query: LibraryQuery, obj: SdfField, model: ObjectModel, match: CoarseMatch, on_step: Callable[[], None]
) -> RefinedMatch:
    """Refine the poses of one match on the fields, and evaluate them. Raises InvalidInputError (FIELD_NOT_FINITE)."""
    counted_scene, counted_object = CountingField(query.scene), CountingField(obj)
    generator = torch.Generator().manual_seed(query.seed)
    problem = make_problem(query.view, model, counted_scene, counted_object, query.options.robust)
    refined = refine_poses(problem, match.poses, generator, on_step)
    evaluation = evaluate_candidates(problem, refined, query.options)
    return RefinedMatch(match.number, problem, evaluation, counted_scene.evaluations + counted_object.evaluations)
