"""Registration of two fields, and search for the object of a detection in a library.

library = [LibraryObject(path.stem, partial(open_field, path), read_object_model(path.with_suffix(".model")))
           for path in paths]
found = search_library(scene, detection, library)
found.ranking[0].name, found.result.T_object_scene
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch

from regnf_core.document import Candidate, ProgressCallback, RegistrationResult
from regnf_core.errors import InvalidInputError
from regnf_core.fields.observation import CountingField, SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import RegistrationOptions
from regnf_core.progress import Run
from regnf_core.robust.constants import LIBRARY
from regnf_core.robust.model import ObjectModel, model_object, read_object_model, signature, write_object_model
from regnf_core.robust.pipeline import (
    cloud_region,
    geometric_seeds,
    refine_poses,
    register_robust,
    result_of,
    search_poses,
)
from regnf_core.robust.problem import RegistrationProblem, make_problem, pose_bound
from regnf_core.robust.scene import SceneView, view_scene
from regnf_core.robust.search.bounds import start_rotations
from regnf_core.robust.verdict.comparison import Comparison, compare, decides_for_other
from regnf_core.robust.verdict.evaluation import Evaluation, evaluate_candidates, level_of
from regnf_core.robust.working_frame import working_device
from regnf_core.surface.result_clouds import with_clouds

__all__ = [
    "Candidate",
    "LibraryObject",
    "LibrarySearch",
    "ObjectModel",
    "model_object",
    "read_object_model",
    "register",
    "search_library",
    "with_late_clouds",
    "write_object_model",
]

_MAX_SQUARED_DISTANCE = 4.0  # of two signatures without a common bin


@dataclass(frozen=True, eq=False)
class LibraryObject:
    """An object of a search. field: opens its field; it is called only for the most probable objects."""

    name: str
    field: Callable[[], SdfField]
    model: ObjectModel


@dataclass(frozen=True)
class LibrarySearch:
    """ranking: every object of the library, the most probable first · result: the registration of the first."""

    ranking: list[Candidate]
    result: RegistrationResult


def search_library(
    scene: SdfField,
    detection: OrientedBox,
    library: Sequence[LibraryObject],
    options: RegistrationOptions | None = None,
    seed: int = 0,
    progress: ProgressCallback | None = None,
    clouds: bool = True,
) -> LibrarySearch:
    """Rank the library's objects for one detection, and register the most probable, by the preset `robust`.

    All are compared by signature, the nearest 12 searched coarsely on samples, at most 4 refined on their fields and
    evaluated: the time hardly grows with the library. Deterministic for a seed. ``progress`` and ``clouds`` as in
    :func:`regnf_core.register`.
    Raises InvalidOptionsError (PRESET_UNSUITABLE) for options of another preset, InvalidInputError
    (LIBRARY_EMPTY, FIELD_NOT_FINITE), InvalidDetectionError, NoSurfaceError.
    """
    options = options or RegistrationOptions()
    options.require_robust("searches a library", reason="PRESET_UNSUITABLE")
    if not library:
        raise InvalidInputError("the library has no objects", reason="LIBRARY_EMPTY")
    run = Run(progress)
    with run.phase("sampling"):
        view = view_scene(scene, detection, options.robust)
    nearest, coarse, refined, told_apart = refined_objects(scene, view, library, options, seed, run)
    evaluation, number, problem, evaluations = refined[0]
    first = library[number]
    with run.phase("verifying"):
        if evaluation.found.verdict == "rejected":  # a whole registration may find what the coarse search lost
            pair = scene, first.field(), detection
            result = register_robust(*pair, options, seed, Run(None), None, first.model, view)
        else:
            result = result_of(problem, evaluation, options, seed, view.evaluations + evaluations)
            if told_apart:
                result = replace(result, deciding=told_apart[0].surface)
    if clouds:
        with run.phase("exporting"):
            result = with_clouds(result, scene, first.field(), detection, cloud_region(detection))
    told = (result.verdict, result.verdict_reason, result.T_object_scene, result.probability, result.level)
    ranking = [Candidate(first.name, "refined", result.metrics["score"], *told)]
    for (other, number, _, _), apart in zip(refined[1:], told_apart, strict=True):
        likely = other.metrics["probability"]
        told = (other.found.verdict, other.found.reason, other.T, likely, level_of(likely))
        ranking.append(Candidate(library[number].name, "refined", other.metrics["score"], *told, apart.difference))
    listed = {number for _, number, _, _ in refined}
    ranking += [Candidate(library[number].name, "coarse", score) for score, number, _ in coarse if number not in listed]
    listed |= {number for _, number, _ in coarse}
    ranking += [Candidate(library[n].name, "signature", apart) for n, apart in nearest if n not in listed]
    return LibrarySearch(ranking, run.finish(result))


Refined = tuple[Evaluation, int, RegistrationProblem, int]
"""What one object came to: its best candidate, its number, its problem, and the evaluations of both fields."""
Coarse = tuple[float, int, Sim3]


def refined_objects(
    scene: SdfField,
    view: SceneView,
    library: Sequence[LibraryObject],
    options: RegistrationOptions,
    seed: int,
    run: Run,
    worst: float = math.inf,
    shortlist: int = LIBRARY.shortlist,
) -> tuple[list[tuple[int, float]], list[Coarse], list[Refined], list[Comparison]]:
    """The objects nearest to the view by signature, those searched coarsely, those refined on their fields, each list
    the best first, and what tells the first refined one from each of the others.

    worst: score of the coarse search, 0..1, above which no object is refined · shortlist: objects that are searched
    coarsely.
    """
    with run.phase("initializing"):
        nearest = rank_by_signature(view, [one.model for one in library])
        there = view.on(working_device(scene))
        coarse = [_searched_coarsely(there, library[n], n, options, seed) for n, _ in nearest[:shortlist]]
        coarse.sort(key=lambda found: found[0])
        worth = [found for found in coarse if found[0] <= min(coarse[0][0] + LIBRARY.margin, worst)][
            : LIBRARY.max_refined
        ]
    refined: list[Refined] = []
    with run.phase("optimizing"):
        for taken, (_, number, poses) in enumerate(worth):
            one, counted = library[number], CountingField(scene)
            obj, generator = CountingField(one.field()), torch.Generator().manual_seed(seed)
            problem = make_problem(view, one.model, counted, obj, options.robust, options.up_axis)
            found = refine_poses(problem, poses, generator, partial(run.optimized, taken / len(worth)))
            evaluation = evaluate_candidates(problem, found, options)
            refined.append((evaluation, number, problem, counted.evaluations + obj.evaluations))
        refined.sort(key=lambda found: found[0].rank)
        told_apart = _decided(refined) if refined else []
    return nearest, coarse, refined, told_apart


def _decided(refined: list[Refined]) -> list[Comparison]:
    """Move the candidate that the surface speaks for by which it differs from the most probable one to the first place,
    but no rejected one before an accepted one. Returns what tells each of the others from the first."""
    placed = {found[1]: found[0].placed(found[2]) for found in refined}
    for found in refined[1:]:
        apart = compare(placed[refined[0][1]], placed[found[1]])
        worse = found[0].rank[0] and not refined[0][0].rank[0]
        if decides_for_other(apart.difference) and not worse:
            refined.remove(found)
            refined.insert(0, found)
            break
    return [compare(placed[refined[0][1]], placed[found[1]]) for found in refined[1:]]


def rank_by_signature(view: SceneView, models: Sequence[ObjectModel]) -> list[tuple[int, float]]:
    """Number of each model and its distance to the view by signature (0..1), nearest first."""
    own = signature(view.foreground)
    apart = torch.stack([(model.signature - own).square().sum() / _MAX_SQUARED_DISTANCE for model in models])
    order: list[int] = apart.argsort(stable=True).tolist()
    return [(number, float(apart[number])) for number in order]


def _searched_coarsely(
    view: SceneView, one: LibraryObject, number: int, options: RegistrationOptions, seed: int
) -> Coarse:
    """The best pose's score (0..1, smaller is better), the number, and poses (H,), best first."""
    model, generator = one.model.on(view.foreground.points.device), torch.Generator().manual_seed(seed)
    bound = pose_bound(view, model, options.robust, options.up_axis)
    seeds = geometric_seeds(view, model, start_rotations(options, LIBRARY.rotations_divisor), bound.scale)
    found = search_poses(view, model, seeds, generator, bound, LIBRARY.stages)
    return float(found.scores[0]), number, found.T


def register(
    scene: SdfField,
    obj: SdfField,
    detection: OrientedBox,
    options: RegistrationOptions | None = None,
    seed: int = 0,
    progress: ProgressCallback | None = None,
    initial_transform: Sim3 | None = None,
    object_model: ObjectModel | None = None,
    clouds: bool = True,
) -> RegistrationResult:
    """Find the pose of a known object in a scanned scene: rotation, position, scale and a verdict.

    ``progress`` is called with the phase and the overall share done (0..1), once an iteration while optimizing; it may
    raise CancelledError. For the preset `robust` alone: ``initial_transform``, a T_object_scene to try first, and
    ``object_model``, what :func:`model_object` made of the object's field earlier.
    Without ``clouds`` the result holds only the samples that the registration used, and neither residuals nor
    surroundings; this saves time when no pictures are drawn.
    Deterministic for a seed, on one machine and with the same number of threads.
    Raises InvalidDetectionError, NoSurfaceError, InitializationError, InvalidInputError (FIELD_NOT_FINITE), and
    InvalidOptionsError (PRESET_UNSUITABLE, INVALID_OPTIONS) for either of the two under another preset.
    """
    options = options or RegistrationOptions()
    if initial_transform is not None:
        options.require_robust("can use an initial transform", reason="PRESET_UNSUITABLE")
    if object_model is not None:
        options.require_robust("uses an object model")
    run = Run(progress)
    if options.preset == "robust":
        result = register_robust(scene, obj, detection, options, seed, run, initial_transform, object_model)
    else:
        from regnf_core.paper import pipeline as paper

        result = paper.register_paper(scene, obj, detection, options, seed, run)
    if clouds:
        with run.phase("exporting"):
            result = with_late_clouds(result, scene, obj, detection, options)
    return run.finish(result)


def with_late_clouds(
    result: RegistrationResult, scene: SdfField, obj: SdfField, detection: OrientedBox, options: RegistrationOptions
) -> RegistrationResult:
    """Adds the point clouds to a result of ``register`` without clouds. Only the time of this phase differs."""
    if options.preset == "robust":
        return with_clouds(result, scene, obj, detection, cloud_region(detection))
    from regnf_core.paper import pipeline as paper

    return with_clouds(result, scene, obj, detection, paper.cloud_region(detection, options))
