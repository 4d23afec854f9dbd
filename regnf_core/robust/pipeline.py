"""Registration without a starting guess, top to bottom: sample, search, refine, judge."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.fields.base import SdfField
from regnf_core.geometry.pose_distance import displacement
from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import RegistrationOptions, RobustOptions
from regnf_core.robust.model.object_model import ObjectModel
from regnf_core.robust.model.self_symmetry import SelfSymmetry
from regnf_core.robust.refine.pose_candidates import LAST, STAGES, Finalists, Trail, run_stage
from regnf_core.robust.residuals import Samples
from regnf_core.robust.samples import split
from regnf_core.robust.scene.scene_view import SceneView
from regnf_core.robust.search.hypotheses import seeds, seeds_about
from regnf_core.robust.search.rotations import super_fibonacci, turns_about
from regnf_core.robust.search.search import ROUNDS, Round, search
from regnf_core.robust.verdict.evidence import Evidence, gather_evidence
from regnf_core.robust.working_frame import WorkingField
from regnf_core.surface.cameras import axis_vector

SCALE_FACTORS = (0.85, 1.0, 1.18)
ITERATIONS = sum(len(stage.widths) for stage in (*STAGES, LAST))
_YAW_SHARE = 10  # rotations of the full search for each turn about a given axis
_WARM_SEEDS = 63
_SAME_POSE = 0.06  # object diameters


@dataclass(frozen=True, eq=False)
class Problem:
    """A detection and an object: what is refined on (A, B), what is judged on (A_held, B_held), in working frames."""

    view: SceneView
    model: ObjectModel
    scene_field: WorkingField
    object_field: WorkingField
    A: Samples
    B: Samples
    A_held: Samples
    B_held: Samples

    def in_field_frames(self, T_work: Sim3) -> Sim3:
        """A single pose between the working frames as T_object_scene."""
        return self.model.frame.to_field() @ T_work @ self.view.frame.to_field().inverse()

    def in_working_frames(self, T_object_scene: Sim3) -> Sim3:
        """A single T_object_scene as a pose between the working frames."""
        return self.model.frame.to_field().inverse() @ T_object_scene @ self.view.frame.to_field()


@dataclass(frozen=True, eq=False)
class Outcome:
    """Finalists, best first, the evidence on them, and where each one started."""

    finalists: Finalists
    evidence: Evidence
    T_initial: Sim3


def pose_problem(
    view: SceneView,
    model: ObjectModel,
    scene: SdfField,
    obj: SdfField,
    options: RobustOptions,
    generator: torch.Generator,
) -> Problem:
    """Split the samples of both surfaces into those to refine on and those to judge on."""
    A, A_held = split(view.foreground, options.held_out_share, generator)
    B, B_held = split(model.samples, options.held_out_share, generator)
    return Problem(view, model, view.field(scene), model.field(obj), A, B, A_held, B_held)


def find_candidates(
    view: SceneView,
    model: ObjectModel,
    rotations: Tensor,
    generator: torch.Generator,
    T_start: Sim3 | None = None,
    rounds: tuple[Round, ...] = ROUNDS,
    more_seeds: Sim3 | None = None,
) -> tuple[Sim3, Tensor]:
    """Candidate poses (H,) and their scores (H,), best first, from the samples alone: no field is evaluated.

    rotations: (K, 3, 3) that the search starts from.
    With ``T_start``, a single pose in working frames, only its neighborhood is searched; ``more_seeds`` (H,) are
    searched beside those of the geometry.
    """
    if T_start is not None:
        T = seeds_about(T_start, _WARM_SEEDS, generator)
    else:
        T = seeds(
            view.foreground.on_surface(),
            model.samples.on_surface(),
            view.detection.rotation,
            view.detection.size / view.detection.diagonal,
            rotations,
            torch.tensor(SCALE_FACTORS),
        )
    if more_seeds is not None:
        T = Sim3.cat([T, more_seeds])
    return search(view.proxy, model.proxy, view.foreground, model.samples, T, model.extremes, generator, rounds)


def refine_candidates(
    problem: Problem,
    candidates: Sim3,
    options: RobustOptions,
    generator: torch.Generator,
    on_step: Callable[[], None] = lambda: None,
) -> Outcome:
    """Refine on the fields, add the winner's twins under the object's symmetries, refine all that is left, judge.

    ``on_step`` is called once for each of the ``ITERATIONS`` iterations.
    """
    scene, obj, ex = problem.scene_field, problem.object_field, problem.model.extremes
    found = None
    most = problem.view.most_offset
    T, offsets = candidates, torch.zeros_like(candidates.scale)
    for stage in STAGES:
        trail = found.trail if found else Trail()
        found = run_stage(scene, obj, problem.A, problem.B, T, stage, ex, generator, trail, on_step, offsets, most)
        T, offsets = found.T, found.offsets
    assert found is not None
    twins = _missing_twins(T, problem.model.symmetry, ex)
    descent = torch.cat([torch.arange(T.scale.numel()), torch.zeros(twins.scale.numel(), dtype=torch.long)])
    trail = found.trail.keep(descent)
    last = run_stage(
        scene,
        obj,
        problem.A,
        problem.B,
        Sim3.cat([T, twins]),
        LAST,
        ex,
        generator,
        trail,
        on_step,
        offsets[descent],
        most,
    )
    evidence = gather_evidence(scene, obj, problem.A_held, problem.B_held, last.T, options, last.offsets)
    T_initial = last.trail.steps[0].T
    return Outcome(last, evidence, T_initial)


def _missing_twins(T: Sim3, symmetry: SelfSymmetry, extremes: Tensor) -> Sim3:
    """The best pose (the first of T) turned by each of the object's symmetries, without those that T holds already."""
    if symmetry.T.scale.numel() == 0:
        return T[:0]
    twins = symmetry.T @ T[:1]
    nearest = torch.stack([displacement(twins, T[i], extremes) for i in range(T.scale.numel())]).amin(0)
    return twins[nearest > _SAME_POSE]


def start_rotations(options: RegistrationOptions, divisor: float = 1.0) -> Tensor:
    """(K, 3, 3) rotations that the search starts from: the option ``rotations`` over ``divisor``, 24 at least.

    All orientations, or turns about the option ``up_axis``.
    """
    count = max(24, int(options.robust.rotations / divisor))
    if options.up_axis is None:
        return super_fibonacci(count)
    return turns_about(axis_vector(options.up_axis), max(24, count // _YAW_SHARE))
