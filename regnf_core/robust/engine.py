"""Registration without a starting guess, top to bottom: sample, search, refine, judge."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.box import OrientedBox
from regnf_core.cameras import axis_vector
from regnf_core.fields.base import SdfField
from regnf_core.options import RobustOptions
from regnf_core.robust.extremes import extreme_points
from regnf_core.robust.finalists import LAST, STAGES, Finalists, Trail, run_stage
from regnf_core.robust.hypotheses import seeds, seeds_about
from regnf_core.robust.judgement import Evidence, gather_evidence
from regnf_core.robust.poses import displacement, join, select
from regnf_core.robust.proxy import ProxyField
from regnf_core.robust.residuals import Samples
from regnf_core.robust.rotations import super_fibonacci, turns_about
from regnf_core.robust.samples import SampledField, sample_object_surface, sample_scene_surface, split
from regnf_core.robust.search import search
from regnf_core.robust.self_symmetry import SelfSymmetry, self_symmetry
from regnf_core.robust.support import support
from regnf_core.sim3 import Sim3

SCALE_FACTORS = (0.85, 1.0, 1.18)
ITERATIONS = sum(len(stage.widths) for stage in (*STAGES, LAST))
_REACH = 0.2  # working units round the samples that a proxy covers
_YAW_SHARE = 10  # rotations of the full search for each turn about a given axis
_EXTREMES = 16
_WARM_SEEDS = 63
_SAME_POSE = 0.06  # object diameters
_FEWEST = 30  # samples in front of the supports; with fewer, the supports are kept after all


@dataclass(frozen=True, eq=False)
class Problem:
    """Both fields sampled: what is refined on (A, B), what is judged on (A_held, B_held), all in working frames."""

    scene: SampledField
    obj: SampledField
    A: Samples
    B: Samples
    A_held: Samples
    B_held: Samples
    foreground: Samples
    extremes: Tensor


@dataclass(frozen=True, eq=False)
class Outcome:
    """Finalists, best first, the evidence on them, where each one started, and the object's symmetries."""

    finalists: Finalists
    evidence: Evidence
    T_initial: Sim3
    symmetry: SelfSymmetry


def prepare(
    scene: SdfField,
    obj: SdfField,
    detection: OrientedBox,
    options: RobustOptions,
    generator: torch.Generator,
) -> Problem:
    """Sample both surfaces and set the supports aside. Raises what the samplers raise."""
    S = sample_scene_surface(scene, detection, options.scene_samples, generator)
    O = sample_object_surface(obj, options.object_samples, generator)  # noqa: E741
    foreground = S.samples[~support(S.samples, generator)]
    if len(foreground) < _FEWEST:
        foreground = S.samples
    A, A_held = split(foreground, options.held_out_share, generator)
    B, B_held = split(O.samples, options.held_out_share, generator)
    extremes = extreme_points(O.samples.on_surface(), _EXTREMES)
    return Problem(S, O, A, B, A_held, B_held, foreground, extremes)


def find_candidates(
    problem: Problem,
    detection: OrientedBox,
    options: RobustOptions,
    generator: torch.Generator,
    T_start: Sim3 | None = None,
) -> tuple[Sim3, SelfSymmetry]:
    """Candidate poses (H,), best first, and the object's own symmetries, from the samples alone.

    With ``T_start``, a single pose in working frames, only its neighbourhood is searched.
    """
    rotations = _rotations(options)
    obj_samples = problem.obj.samples
    scene_proxy = _proxy(problem.foreground, problem.scene.spacing)
    object_proxy = _proxy(obj_samples, problem.obj.spacing)
    if T_start is not None:
        T = seeds_about(T_start, _WARM_SEEDS, generator)
    else:
        T = seeds(
            problem.foreground.on_surface(),
            obj_samples.on_surface(),
            detection.rotation,
            detection.size / detection.diagonal,
            rotations,
            torch.tensor(SCALE_FACTORS),
        )
    T, _ = search(scene_proxy, object_proxy, problem.foreground, obj_samples, T, problem.extremes, generator)
    return T, self_symmetry(object_proxy, obj_samples, problem.extremes, rotations, generator)


def refine_candidates(
    problem: Problem,
    candidates: Sim3,
    symmetry: SelfSymmetry,
    options: RobustOptions,
    generator: torch.Generator,
    on_step: Callable[[], None] = lambda: None,
) -> Outcome:
    """Refine on the fields, add the winner's twins under the object's symmetries, refine all that is left, judge.

    ``on_step`` is called once for each of the ``ITERATIONS`` iterations.
    """
    scene, obj, ex = problem.scene.field, problem.obj.field, problem.extremes
    found = None
    T = candidates
    for stage in STAGES:
        found = run_stage(
            scene, obj, problem.A, problem.B, T, stage, ex, generator, found.trail if found else Trail(), on_step
        )
        T = found.T
    assert found is not None
    twins = _missing_twins(T, symmetry, ex)
    descent = torch.cat([torch.arange(T.scale.numel()), torch.zeros(twins.scale.numel(), dtype=torch.long)])
    trail = found.trail.keep(descent)
    last = run_stage(scene, obj, problem.A, problem.B, join([T, twins]), LAST, ex, generator, trail, on_step)
    evidence = gather_evidence(scene, obj, problem.A_held, problem.B_held, last.T, options)
    T_initial = last.trail.steps[0].T
    return Outcome(last, evidence, T_initial, symmetry)


def _missing_twins(T: Sim3, symmetry: SelfSymmetry, extremes: Tensor) -> Sim3:
    """The best pose (the first of T) turned by each of the object's symmetries, without those that T holds already."""
    if symmetry.T.scale.numel() == 0:
        return select(T, torch.tensor([], dtype=torch.long))
    twins = symmetry.T @ select(T, torch.tensor([0]))
    nearest = torch.stack(
        [displacement(twins, select(T, torch.tensor(i)), extremes) for i in range(T.scale.numel())]
    ).amin(0)
    return select(twins, nearest > _SAME_POSE)


def _rotations(options: RobustOptions) -> Tensor:
    if options.up_axis is None:
        return super_fibonacci(options.rotations)
    return turns_about(axis_vector(options.up_axis), max(24, options.rotations // _YAW_SHARE))


def _proxy(samples: Samples, spacing: float) -> ProxyField:
    return ProxyField(samples.on_surface(), samples.normals, spacing, _REACH)
