"""Which object of a library a detection shows, and where it stands.

library = [LibraryObject(path.stem, partial(open_field, path), read_object_model(path.with_suffix(".model")))
           for path in paths]
found = search_library(scene, detection, library)
found.ranking[0].name, found.result.T_object_scene
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from regnf_core.document import STARTS, Candidate, ProgressCallback, RegistrationResult, Run
from regnf_core.errors import InvalidInputError
from regnf_core.fields.observation import SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.options import RegistrationOptions
from regnf_core.paper import pipeline as paper
from regnf_core.robust.library_search import (
    CoarseMatch,
    LibraryQuery,
    RefinedMatch,
    match_coarsely,
    rank_by_signature,
    refine_match,
    worth_refining,
)
from regnf_core.robust.model import ObjectModel, model_object, read_object_model, write_object_model
from regnf_core.robust.pipeline import WarmStart, cloud_region, register_robust, result_of
from regnf_core.robust.scene import view_scene
from regnf_core.surface.result_clouds import with_clouds


@dataclass(frozen=True, eq=False)
class LibraryObject:
    """An object to look for. field: opens its field; called only for the few objects that may be the right one."""

    name: str
    field: Callable[[], SdfField]
    model: ObjectModel


@dataclass(frozen=True)
class LibrarySearch:
    """ranking: every object of the library, the likeliest first · result: the registration of the first."""

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
    """Rank the library's objects for one detection, and register the likeliest, by the preset `robust`.

    All are compared by signature, the nearest 12 searched coarsely, at most 4 refined on their fields and evaluated:
    the time hardly grows with the library. Deterministic for a seed. ``progress`` and ``clouds`` as in
    :func:`regnf_core.register`.
    Raises InvalidOptionsError (PRESET_UNSUITABLE) for options of another preset, InvalidInputError
    (LIBRARY_EMPTY, FIELD_NOT_FINITE), InvalidDetectionError, NoSurfaceError.
    """
    options = options or RegistrationOptions()
    options.require_robust("searches a library", reason="PRESET_UNSUITABLE")
    if not library:
        raise InvalidInputError("the library has no objects", reason="LIBRARY_EMPTY")
    run = Run(progress)
    models = [one.model for one in library]
    with run.phase("sampling"):
        query = LibraryQuery(scene, view_scene(scene, detection, options.robust), options, seed)
    with run.phase("initializing"):
        nearest = rank_by_signature(query.view, models)
        coarse = match_coarsely(query, models, [number for number, _ in nearest])
    with run.phase("optimizing"):
        refined = _refine(query, library, worth_refining(coarse), run)
    with run.phase("verifying"):
        first = library[refined[0].number]
        result = _register_first(query, first, refined[0])

    def add_clouds(found: RegistrationResult) -> RegistrationResult:
        return with_clouds(found, scene, first.field(), detection, cloud_region(detection))

    result = run.finish(result, add_clouds if clouds else None)
    return LibrarySearch(_ranking(library, nearest, coarse, refined, result), result)


def _refine(
    query: LibraryQuery, library: Sequence[LibraryObject], matches: Sequence[CoarseMatch], run: Run
) -> list[RefinedMatch]:
    """The matches refined on their fields, best first."""
    span = (STARTS["verifying"] - STARTS["optimizing"]) / len(matches)
    refined = []
    for taken, match in enumerate(matches):
        done = STARTS["optimizing"] + span * taken
        one = library[match.number]

        def on_step(done: float = done) -> None:
            run.report("optimizing", done)

        refined.append(refine_match(query, one.field(), one.model, match, on_step))
    return sorted(refined, key=lambda found: found.evaluation.rank)


def _register_first(query: LibraryQuery, one: LibraryObject, match: RefinedMatch) -> RegistrationResult:
    """The first match's result; where the coarse search led to a rejection, that of a whole registration."""
    view, options, seed = query.view, query.options, query.seed
    if match.evaluation.verdict == "rejected":
        known = WarmStart(object_model=one.model)
        return register_robust(query.scene, one.field(), view.detection, options, seed, Run(None), known, view)
    evaluations = view.evaluations + match.field_evaluations
    return result_of(match.problem, match.evaluation, options, seed, evaluations)


def _ranking(
    library: Sequence[LibraryObject],
    nearest: Sequence[tuple[int, float]],
    coarse: Sequence[CoarseMatch],
    refined: Sequence[RefinedMatch],
    result: RegistrationResult,
) -> list[Candidate]:
    """All objects, those that came farthest first."""
    first, score = library[refined[0].number].name, result.metrics["score"]
    found = (result.verdict, result.verdict_reason, result.T_object_scene, result.probability)
    ranking = [Candidate(first, "refined", score, *found)]
    for match in refined[1:]:
        other, name = match.evaluation, library[match.number].name
        found = (other.verdict, other.reason, other.T, other.metrics["probability"])
        ranking.append(Candidate(name, "refined", other.metrics["score"], *found))
    listed = {match.number for match in refined}
    ranking += [Candidate(library[c.number].name, "coarse", c.score) for c in coarse if c.number not in listed]
    listed |= {match.number for match in coarse}
    ranking += [Candidate(library[n].name, "signature", apart) for n, apart in nearest if n not in listed]
    return ranking


__all__ = [
    "Candidate",
    "LibraryObject",
    "LibrarySearch",
    "ObjectModel",
    "model_object",
    "read_object_model",
    "search_library",
    "write_object_model",
]


# Registration of two fields: by the preset that the options name, then the point clouds of the result.

__all__ = ["WarmStart", "register", "with_late_clouds"]


def register(
    scene: SdfField,
    obj: SdfField,
    detection: OrientedBox,
    options: RegistrationOptions | None = None,
    seed: int = 0,
    progress: ProgressCallback | None = None,
    warm_start: WarmStart | None = None,
    clouds: bool = True,
) -> RegistrationResult:
    """Find where a known object stands in a scanned scene: rotation, position and scale, with a verdict.

    ``progress`` is called with the phase and the overall share done (0..1), once an iteration while optimizing; it may
    raise CancelledError. ``warm_start``, for the preset `robust` alone: a pose to try first, and the object's model.
    Without ``clouds`` the result holds only the samples that the registration used, and neither residuals nor
    surroundings; this saves time when no pictures are drawn.
    Deterministic for a seed, on one machine and with the same number of threads.
    Raises InvalidDetectionError, NoSurfaceError, InitializationError, InvalidInputError (FIELD_NOT_FINITE), and
    InvalidOptionsError (PRESET_UNSUITABLE, INVALID_OPTIONS) for a warm start under another preset.
    """
    options = options or RegistrationOptions()
    if warm_start is not None:
        _check_warm_start(warm_start, options)
    run = Run(progress)
    if options.preset == "robust":
        result = register_robust(scene, obj, detection, options, seed, run, warm_start)
    else:
        result = paper.register_paper(scene, obj, detection, options, seed, run)
    return run.finish(
        result, (lambda found: with_late_clouds(found, scene, obj, detection, options)) if clouds else None
    )


def with_late_clouds(
    result: RegistrationResult, scene: SdfField, obj: SdfField, detection: OrientedBox, options: RegistrationOptions
) -> RegistrationResult:
    """The result of ``register`` without clouds as it returns it with them, but for the seconds of this phase."""
    region = cloud_region(detection) if options.preset == "robust" else paper.cloud_region(detection, options)
    return with_clouds(result, scene, obj, detection, region)


def _check_warm_start(warm_start: WarmStart, options: RegistrationOptions) -> None:
    if warm_start.T_object_scene is not None:
        options.require_robust("starts from a given transform", reason="PRESET_UNSUITABLE")
    if warm_start.object_model is not None:
        options.require_robust("uses an object model")
