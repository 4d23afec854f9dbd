"""Which object of a library a detection shows, and where it stands.

library = [LibraryObject(path.stem, partial(open_field, path), read_object_model(path.with_suffix(".model")))
           for path in paths]
found = search_library(scene, detection, library)
found.ranking[0].name, found.result.T_object_scene
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from regnf_core.errors import InvalidInputError
from regnf_core.fields.base import SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import RegistrationOptions
from regnf_core.result import ProgressCallback, RegistrationResult, Verdict
from regnf_core.robust.library_search import (
    Contender,
    Finalist,
    by_signature,
    coarsely,
    refine_contender,
    still_in,
)
from regnf_core.robust.model.model_file import read_object_model, write_object_model
from regnf_core.robust.model.object_model import ObjectModel, model_object
from regnf_core.robust.register import WarmStart, cloud_region, register_robust
from regnf_core.robust.report import result_of
from regnf_core.robust.scene.scene_view import SceneView, view_scene
from regnf_core.run import STARTS, Run
from regnf_core.surface.result_clouds import with_clouds

Stage = Literal["refined", "coarse", "signature"]


@dataclass(frozen=True, eq=False)
class LibraryObject:
    """An object to look for. field: opens its field, called for the few that may be the right one alone."""

    name: str
    field: Callable[[], SdfField]
    model: ObjectModel


@dataclass(frozen=True)
class Candidate:
    """What a search found out about one object.

    stage: how far it came · score: 0..1, smaller is better, to be compared within a stage only. Verdict, reason and
    transform are those of a registration, for ``refined`` objects; None for the others.
    """

    name: str
    stage: Stage
    score: float
    verdict: Verdict | None = None
    verdict_reason: str | None = None
    T_object_scene: Sim3 | None = None


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
) -> LibrarySearch:
    """Rank the library's objects for one detection, and register the likeliest, by the preset `robust`.

    All are compared by signature, the nearest 12 searched coarsely, at most 4 refined on their fields and judged: the
    time hardly grows with the library. Deterministic for a seed. ``progress`` as in :func:`regnf_core.register`.
    Raises InvalidOptionsError (LIBRARY_SEARCH_UNSUPPORTED) for options of another preset, InvalidInputError
    (LIBRARY_EMPTY, FIELD_NOT_FINITE), InvalidDetectionError, NoSurfaceError.
    """
    options = options or RegistrationOptions()
    options.require_robust("searches a library", reason="LIBRARY_SEARCH_UNSUPPORTED")
    if not library:
        raise InvalidInputError("a library without objects", reason="LIBRARY_EMPTY")
    run = Run(progress)
    models = [one.model for one in library]
    with run.phase("sampling"):
        view = view_scene(scene, detection, options.robust, seed)
    with run.phase("initializing"):
        nearest = by_signature(view, models)
        contenders = coarsely(view, models, [number for number, _ in nearest], options, seed)
    with run.phase("optimizing"):
        finalists = _refine(scene, view, library, still_in(contenders), options, seed, run)
    with run.phase("verifying"):
        result = _register_first(scene, view, library[finalists[0].number], finalists[0], options, seed)

    def add_clouds(found: RegistrationResult) -> RegistrationResult:
        obj = library[finalists[0].number].field()
        return with_clouds(found, scene, obj, detection, cloud_region(detection))

    result = run.finish(result, add_clouds)
    return LibrarySearch(_ranking(library, nearest, contenders, finalists, result), result)


def _refine(
    scene: SdfField,
    view: SceneView,
    library: Sequence[LibraryObject],
    contenders: Sequence[Contender],
    options: RegistrationOptions,
    seed: int,
    run: Run,
) -> list[Finalist]:
    """The contenders refined on their fields, best first."""
    span = (STARTS["verifying"] - STARTS["optimizing"]) / len(contenders)
    finalists = []
    for taken, contender in enumerate(contenders):
        done = STARTS["optimizing"] + span * taken
        one = library[contender.number]

        def on_step(done: float = done) -> None:
            run.report("optimizing", done)

        finalists.append(refine_contender(scene, view, one.field(), one.model, contender, options, seed, on_step))
    return sorted(finalists, key=lambda finalist: finalist.conclusion.rank)


def _register_first(
    scene: SdfField,
    view: SceneView,
    one: LibraryObject,
    finalist: Finalist,
    options: RegistrationOptions,
    seed: int,
) -> RegistrationResult:
    """The first finalist's result; where the coarse search led to a rejection, that of a registration from scratch."""
    if finalist.conclusion.verdict == "rejected":
        quiet = Run(None)
        return register_robust(
            scene, one.field(), view.detection, options, seed, quiet, WarmStart(object_model=one.model), view
        )
    evaluations = view.evaluations + finalist.evaluations
    return result_of(finalist.problem, finalist.outcome, finalist.conclusion, options, seed, evaluations)


def _ranking(
    library: Sequence[LibraryObject],
    nearest: Sequence[tuple[int, float]],
    contenders: Sequence[Contender],
    finalists: Sequence[Finalist],
    result: RegistrationResult,
) -> list[Candidate]:
    first, others = finalists[0], finalists[1:]
    score = result.metrics["score"]
    ranking = [
        Candidate(
            library[first.number].name, "refined", score, result.verdict, result.verdict_reason, result.T_object_scene
        )
    ]
    for one in others:
        end = one.conclusion
        name = library[one.number].name
        ranking.append(Candidate(name, "refined", end.metrics["score"], end.verdict, end.reason, end.T))
    named = {one.number for one in finalists}
    ranking += [Candidate(library[c.number].name, "coarse", c.score) for c in contenders if c.number not in named]
    named |= {one.number for one in contenders}
    ranking += [Candidate(library[n].name, "signature", apart) for n, apart in nearest if n not in named]
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
