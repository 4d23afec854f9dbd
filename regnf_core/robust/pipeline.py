"""The preset `robust` as one call, in seven steps. What each does stands in docs/robust.md."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import count

import torch
from torch import Tensor

from regnf_core.document import IterationRecord, RegistrationResult
from regnf_core.fields.observation import CountingField, SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.metrics import displacement
from regnf_core.geometry.sim3 import Sim3
from regnf_core.geometry.surface_samples import SurfaceSamples
from regnf_core.options import RegistrationOptions
from regnf_core.progress import Run
from regnf_core.robust.constants import REFINEMENT, SAMPLING, SEARCH, Stage
from regnf_core.robust.model import ObjectModel, model_object
from regnf_core.robust.problem import RegistrationProblem, make_problem
from regnf_core.robust.refine.levenberg_marquardt import RefinementContext, coarse_to_fine
from regnf_core.robust.refine.pose_candidates import Iterations, PoseCandidates
from regnf_core.robust.residuals import SurfacePair
from regnf_core.robust.scene import SceneView, view_scene
from regnf_core.robust.search.bounds import (
    ANY_SCALE,
    PoseBound,
    ScaleBound,
    seed_poses,
    seed_poses_around,
    seen_seeds,
    start_rotations,
)
from regnf_core.robust.search.distance_grid import feature_seeds
from regnf_core.robust.verdict.evaluation import Evaluation, evaluate_candidates, level_of, pose_covariance
from regnf_core.robust.working_frame import Samples, WorkingFrame, fixed_generator

_GEMAN_MCCLURE = -2.0
"""The Geman-McClure kernel as the shape of Barron's general kernel (CVPR 2019)."""
ITERATIONS = sum(len(stage.widths) for stage in (*REFINEMENT.stages, *REFINEMENT.last_stages))
"""Of the refinement on the fields."""


def register_robust(
    scene_field: SdfField,
    object_field: SdfField,
    detection: OrientedBox,
    options: RegistrationOptions,
    seed: int,
    run: Run,
    initial_transform: Sim3 | None = None,
    object_model: ObjectModel | None = None,
    scene_view: SceneView | None = None,
) -> RegistrationResult:
    """T_object_scene from two fields and a box, with a verdict, all equivalent poses and a covariance.

    initial_transform: its neighborhood is searched first, everything else only if that ends in a rejection or in an
    answer less likely than 0.95 · object_model, scene_view: made earlier, of this object, scene, box and options.
    The work is done on the device of the scene's field. Random numbers are drawn on the CPU, whatever the device.
    Deterministic for a seed, on one machine and with the same number of threads.
    Raises InvalidDetectionError, NoSurfaceError, InvalidInputError (FIELD_NOT_FINITE).
    """
    scene, obj = CountingField(scene_field), CountingField(object_field)
    generator = torch.Generator().manual_seed(seed)
    with run.phase("sampling"):
        # 1. Surface points of the scene in the box.
        view = scene_view or view_scene(scene_field, detection, options.robust)
        # 2. Surface points of the object, and its symmetries.
        model = object_model or model_object(obj, options.robust)
        problem = make_problem(view, model, scene, obj, options.robust, options.up_axis)
    evaluation: Evaluation | None = None
    for seeds, given, stages in _starts(problem, options, seed, generator, initial_transform):
        # 3. Seeds: around a given pose; else from the two shapes and the box; else from matched features too.
        with run.phase("initializing"):
            # 4. Search: where the seeds lead to on distance grids. No field is evaluated.
            searched = search_poses(problem.view, problem.model, seeds, generator, problem.bound, stages)
        with run.phase("optimizing"):
            # 5. Refinement of the best poses, and of their symmetric equivalents, on the fields.
            poses = Sim3.cat([searched.T, given])
            taken = count(1)
            on_step = lambda: run.optimized(next(taken) / ITERATIONS)  # noqa: E731, B023 -- called within this turn
            refined = refine_poses(problem, poses, generator, on_step)
        with run.phase("verifying"):
            # 6. Verdict on held-out samples. A pose is compared with all that earlier starts led to.
            known = None if evaluation is None else evaluation.held_out
            if evaluation is not None:
                refined = PoseCandidates.cat([evaluation.candidates.on(refined.scores.device), refined])
            evaluation = evaluate_candidates(problem, refined, options, known)
        if not evaluation.doubtful:
            break
    assert evaluation is not None  # there is always a start
    # 7. Covariance, and all of it in the fields' own frames.
    evaluations = view.evaluations + scene.evaluations + obj.evaluations
    return result_of(problem, evaluation, options, seed, evaluations)


def _starts(
    problem: RegistrationProblem,
    options: RegistrationOptions,
    seed: int,
    generator: torch.Generator,
    T_known: Sim3 | None,
) -> Iterator[tuple[Sim3, Sim3, Sequence[Stage]]]:
    """Slower ways where the faster ones before fail or leave doubt, each made when its turn comes.

    Seeds (H,), what is refined whatever the search finds (1,) or (0,), and the stages of the search.
    """
    view, model, device = problem.view, problem.model, problem.view.foreground.points.device
    if T_known is not None:
        near = problem.in_working_frames(T_known).on(device)
        yield seed_poses_around(near, generator), near.expand(1), SEARCH.stages
    seeds = geometric_seeds(view, model, start_rotations(options), problem.bound.scale)
    yield seeds, seeds[:0], SEARCH.stages
    if options.robust.feature_draws:
        matched = feature_seeds(view.foreground, model.samples, options.robust.feature_draws, seed)
        yield Sim3.cat([seeds, matched.on(device)]), seeds[:0], SEARCH.thorough_stages


def geometric_seeds(view: SceneView, model: ObjectModel, rotations: Tensor, scale: ScaleBound = ANY_SCALE) -> Sim3:
    """Seeds (H,) from the two shapes and the box, for each of the rotations (K, 3, 3)."""
    box, device = view.detection, view.foreground.points.device
    scene, obj = view.foreground.on_surface(), model.samples.on_surface()
    if view.of_thing and scale.log_width < math.inf:
        middle = math.sqrt(scale.low * scale.high)
        return seen_seeds(scene, obj, model.samples.normals, box.rotation.to(device), rotations.to(device), middle)
    return seed_poses(
        scene,
        obj,
        box.rotation.to(device),
        (box.size / box.diagonal).to(device),
        rotations.to(device),
        torch.tensor(SEARCH.scale_factors, device=device),
        scale,
    )


def search_poses(
    view: SceneView,
    model: ObjectModel,
    seeds: Sim3,
    generator: torch.Generator,
    bound: PoseBound,
    stages: Sequence[Stage] = SEARCH.stages,
) -> PoseCandidates:
    """The best poses that the seeds (H,) lead to, best first, from the samples alone: no field is evaluated.

    bound: what is known of a pose. Seeds that it does not admit, loosened, are left out, unless it admits none.
    """
    seeds = bound.scale.limited_poses(seeds)
    near = bound.loosened(SEARCH.seed_tolerance).admits(seeds)
    seeds = seeds[near.nonzero().squeeze(-1)] if bool(near.any()) else seeds  # a wrong box must not end the search
    grids = SurfacePair(view.distance_grid, model.distance_grid, view.foreground, model.samples, view.ahead)
    context = RefinementContext(model.extremal_points, generator, bound.scale, bound=bound)
    return coarse_to_fine(grids, PoseCandidates.start(seeds), stages, context)


def refine_poses(
    problem: RegistrationProblem, T: Sim3, generator: torch.Generator, on_step: Callable[[], None] = lambda: None
) -> PoseCandidates:
    """Poses T (H,) refined on the fields, best first; the best one's symmetry equivalents join for the last stages.

    ``on_step`` is called once for each of the ``ITERATIONS`` iterations.
    """
    bound, offset = problem.bound, problem.view.max_offset
    context = RefinementContext(
        problem.model.extremal_points, generator, bound.scale, offset, on_step, bound, with_history=True
    )
    start = PoseCandidates.start(bound.scale.limited_poses(T), with_offsets=True)
    found = coarse_to_fine(problem.fit, start, REFINEMENT.stages, context)
    symmetry, points = problem.model.symmetry, problem.model.extremal_points
    if len(symmetry.T):
        # The best pose under each of the object's symmetries, but for those that are among the candidates already.
        equivalents = symmetry.T @ found.T[:1]
        nearest = torch.stack([displacement(equivalents, one, points) for one in found.T]).amin(0)
        equivalents = equivalents[nearest > REFINEMENT.same_pose]
        origins = torch.arange(len(found) + len(equivalents), device=found.scores.device)
        found = replace(found[origins.where(origins < len(found), 0)], T=Sim3.cat([found.T, equivalents]))
    # The last stages' samples are the same for every seed: the same optimum is met at the same place.
    last = replace(context, generator=fixed_generator())
    return coarse_to_fine(problem.fit, found, REFINEMENT.last_stages, last)


def result_of(
    problem: RegistrationProblem, evaluation: Evaluation, options: RegistrationOptions, seed: int, evaluations: int
) -> RegistrationResult:
    """The result of a registration. evaluations: of both fields, in total."""
    view, model = problem.view, problem.model
    assert evaluation.candidates.history is not None, "refined poses have iterations"
    history = evaluation.candidates.history[evaluation.winner]
    return RegistrationResult(
        verdict=evaluation.found.verdict,
        verdict_reason=evaluation.found.reason,
        verdict_limit=evaluation.found.broken,
        T_object_scene=evaluation.T,
        T_object_scene_initial=problem.in_field_frames(history.T[0]),
        scene_samples=_surface(view.foreground, view.frame),
        object_samples=_surface(model.samples, model.frame),
        metrics={**evaluation.metrics, "field_evaluations": float(evaluations)},
        trace=_trace(problem, history),
        residuals={},
        seed=seed,
        options=options.to_dict(),
        alternatives=evaluation.alternatives,
        considered=evaluation.considered,
        center_object=model.frame.center.clone(),
        covariance=pose_covariance(problem, evaluation),
        symmetry=model.symmetry.on("cpu").group(),
        level=level_of(evaluation.metrics["probability"]),
    )


def _surface(samples: Samples, frame: WorkingFrame) -> SurfaceSamples:
    return SurfaceSamples(frame.out_of(samples.on_surface()), samples.normals.cpu())


def _trace(problem: RegistrationProblem, history: Iterations) -> list[IterationRecord]:
    """The iterations (K,) of the pose that won."""
    size = problem.model.frame.length
    T = problem.in_field_frames(history.T)
    columns = (history.costs, history.residual_scene, history.residual_object, T.scale)
    rows = zip(history.widths, history.samples, *(column.tolist() for column in columns), strict=True)
    return [
        IterationRecord(
            iteration=number,
            loss=cost,
            residual_scene=of_scene * size,
            residual_object=of_object * size / scale,
            regularizer=0.0,
            kernel_shape=_GEMAN_MCCLURE,
            kernel_scale=width * size,
            scene_samples=min(samples, len(problem.fit.scene_samples)),
            object_samples=min(samples, len(problem.fit.object_samples)),
            T_object_scene=T[number],
        )
        for number, (width, samples, cost, of_scene, of_object, scale) in enumerate(rows)
    ]


def cloud_region(detection: OrientedBox) -> Callable[[Tensor], Tensor]:
    """What says which points (N, 3) of the scene may belong to a result's clouds, (N,) bool.

    Those in the detection box, grown a little. No ground is removed: which way is up need not be known.
    """
    return lambda points: detection.contains(points, SAMPLING.cloud_margin)
