"""Several pairs of one scene, registered by the preset `robust` in lock step."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import torch

from regnf_core.errors import CancelledError, RegnfError
from regnf_core.fields.observation import CountingField, SdfField
from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import RegistrationOptions
from regnf_core.result import STARTS, Phase, RegistrationResult, Run
from regnf_core.robust.constants import REFINEMENT
from regnf_core.robust.fused.lock_step import OnStep, all_coarse_to_fine
from regnf_core.robust.fused.parts import Sizes
from regnf_core.robust.model import ObjectModel
from regnf_core.robust.pipeline import (
    Start,
    evaluate_with,
    last_descent,
    refinement_start,
    result_of,
    search_start,
    starts_of,
)
from regnf_core.robust.problem import RegistrationProblem, make_problem
from regnf_core.robust.refine.levenberg_marquardt import Descent
from regnf_core.robust.refine.pose_candidates import PoseCandidates
from regnf_core.robust.scene import SceneView
from regnf_core.robust.verdict.evaluation import Evaluation


@dataclass(frozen=True, eq=False)
class SampledPair:
    """A detection and an object whose samples are there: the view is of the detection, the model of the object."""

    view: SceneView
    obj: SdfField
    model: ObjectModel


@dataclass(eq=False)
class _Lane:
    """A pair on its way. found: an evaluation for each attempt · error: what it failed by."""

    problem: RegistrationProblem
    generator: torch.Generator
    starts: Iterator[Start]
    counts: tuple[CountingField, CountingField]
    found: list[Evaluation] = field(default_factory=list)
    error: RegnfError | None = None

    @property
    def waits(self) -> bool:
        """Whether another attempt is worth it."""
        return self.error is None and (not self.found or self.found[-1].doubtful)


def register_together(
    scene: SdfField, pairs: Sequence[SampledPair], options: RegistrationOptions, seed: int, run: Run, sizes: Sizes
) -> list[RegistrationResult | RegnfError]:
    """For each pair what ``register_robust`` gives, up to rounding, or what it failed by.

    A pair's result does not depend on the other pairs, nor on their order. Raises CancelledError.
    """
    lanes = [_lane(scene, pair, options, seed) for pair in pairs]
    while ready := [(lane, start) for lane in lanes if lane.waits and (start := next(lane.starts, None)) is not None]:
        _attempt(ready, options, run, sizes)
    return [_result(lane, options, seed) for lane in lanes]


def _lane(scene: SdfField, pair: SampledPair, options: RegistrationOptions, seed: int) -> _Lane:
    generator = torch.Generator().manual_seed(seed)
    counts = CountingField(scene), CountingField(pair.obj)
    problem = make_problem(pair.view, pair.model, *counts, options.robust)
    return _Lane(problem, generator, starts_of(problem, options, seed, generator, None), counts)


def _attempt(ready: Sequence[tuple[_Lane, Start]], options: RegistrationOptions, run: Run, sizes: Sizes) -> None:
    lanes, stages = [lane for lane, _ in ready], ready[0][1].stages
    with run.phase("initializing"):
        searches = [
            search_start(lane.problem.view, lane.problem.model, start.seeds, lane.generator, lane.problem.bound)
            for lane, start in ready
        ]
        found = all_coarse_to_fine(searches, stages, sizes, _progress(run, "initializing", "optimizing"))
    with run.phase("optimizing"):
        begun = _going_on(lanes, found)
        starts = [
            refinement_start(lane.problem, Sim3.cat([one.T, start.given]), lane.generator)
            for (lane, start), one in zip(ready, found, strict=True)
            if isinstance(one, PoseCandidates)
        ]
        refined = _refined(begun, starts, sizes, run)
    with run.phase("verifying"):
        for lane, one in zip(begun, refined, strict=True):
            if isinstance(one, PoseCandidates):
                _evaluate(lane, one, options)
                run.report("verifying", STARTS["verifying"])
            else:
                lane.error = one


def _going_on(lanes: Sequence[_Lane], found: Sequence[PoseCandidates | RegnfError]) -> list[_Lane]:
    """The lanes that have candidates; the others keep their error."""
    for lane, one in zip(lanes, found, strict=True):
        lane.error = one if isinstance(one, RegnfError) else None
    return [lane for lane in lanes if lane.error is None]


def _refined(
    lanes: Sequence[_Lane], starts: Sequence[Descent], sizes: Sizes, run: Run
) -> list[PoseCandidates | RegnfError]:
    """As ``refine_poses``, for all lanes."""
    counts = [sum(len(stage.widths) for stage in some) for some in (REFINEMENT.stages, REFINEMENT.last_stages)]
    middle = STARTS["optimizing"] + (STARTS["verifying"] - STARTS["optimizing"]) * counts[0] / sum(counts)
    first = _Progress(run, "optimizing", STARTS["optimizing"], middle)
    found = all_coarse_to_fine(starts, REFINEMENT.stages, sizes, first)
    whole = [number for number, one in enumerate(found) if isinstance(one, PoseCandidates)]
    joined = []
    for number in whole:
        one, start = found[number], starts[number]
        assert isinstance(one, PoseCandidates)
        joined.append(last_descent(lanes[number].problem, start, one))
    last = _Progress(run, "optimizing", middle, STARTS["verifying"])
    ends = all_coarse_to_fine(joined, REFINEMENT.last_stages, sizes, last)
    for number, end in zip(whole, ends, strict=True):
        found[number] = end
    return found


def _evaluate(lane: _Lane, candidates: PoseCandidates, options: RegistrationOptions) -> None:
    try:
        lane.found.append(evaluate_with(lane.found, lane.problem, candidates, options))
    except CancelledError:
        raise
    except RegnfError as error:
        lane.error = error


def _result(lane: _Lane, options: RegistrationOptions, seed: int) -> RegistrationResult | RegnfError:
    if lane.error is not None:
        return lane.error
    best = lane.found[-1]
    evaluations = lane.problem.view.evaluations + sum(one.evaluations for one in lane.counts)
    return result_of(lane.problem, best, options, seed, evaluations)


class _Progress:
    """Reports a phase, from one overall share to another, as steps are done."""

    def __init__(self, run: Run, phase: Phase, begin: float, end: float) -> None:
        self._run, self._phase, self._begin, self._span = run, phase, begin, end - begin
        self._done = 0.0

    def __call__(self, share: float) -> None:
        self._done += share
        self._run.report(self._phase, self._begin + self._span * min(self._done, 1.0))


def _progress(run: Run, phase: Phase, following: Phase) -> OnStep:
    return _Progress(run, phase, STARTS[phase], STARTS[following])
