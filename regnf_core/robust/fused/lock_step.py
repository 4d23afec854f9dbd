"""The coarse-to-fine loop of several pairs in lock step: each stage refines the poses of all of them together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import accumulate, pairwise

import torch
from torch import Tensor

from regnf_core.errors import InvalidInputError, RegnfError
from regnf_core.fields.observation import CountingField
from regnf_core.robust.constants.model import Stage
from regnf_core.robust.fused.parts import Part, Sizes, parts_of
from regnf_core.robust.fused.stacking import StackedSurfaces, kind_of
from regnf_core.robust.refine.levenberg_marquardt import Descent, Settings, refined, survivors
from regnf_core.robust.refine.pose_candidates import PoseCandidates
from regnf_core.robust.residuals import DistanceModel, SurfacePair
from regnf_core.robust.search.bounds import ANY_SCALE, ScaleBounds
from regnf_core.robust.working_frame import WorkingField

OnStep = Callable[[float], None]
"""Called after each iteration of a part, with its share of the iterations of all stages."""


def all_coarse_to_fine(
    starts: Sequence[Descent], stages: Sequence[Stage], sizes: Sizes, on_step: OnStep
) -> list[PoseCandidates | RegnfError]:
    """For each pair the candidates that are left after all stages, best first, or what it failed by.

    The random numbers are those that ``coarse_to_fine`` draws for each pair.
    """
    found: list[PoseCandidates | RegnfError] = [start.candidates for start in starts]
    iterations = sum(max(1, len(stage.widths)) for stage in stages)
    for stage in stages:
        ready = {
            number: replace(starts[number], candidates=one).prepared(stage)
            for number, one in enumerate(found)
            if isinstance(one, PoseCandidates)
        }
        kinds: dict[object, list[int]] = {}
        for number, one in ready.items():
            kinds.setdefault(kind_of(one.surfaces), []).append(number)
        for numbers in kinds.values():
            share = len(numbers) / len(ready) / iterations
            done = _one_stage([ready[number] for number in numbers], stage, sizes, _scaled(on_step, share))
            for number, end in zip(numbers, done, strict=True):
                found[number] = end
    return found


def _scaled(on_step: OnStep, factor: float) -> OnStep:
    return lambda share: on_step(share * factor)


def _one_stage(
    ready: Sequence[Descent], stage: Stage, sizes: Sizes, on_step: OnStep
) -> list[PoseCandidates | RegnfError]:
    """Pairs of one kind after a stage."""
    counts = [len(one.candidates) for one in ready]
    places = [slice(*ends) for ends in pairwise([0, *accumulate(counts)])]
    candidates, broken = _all_refined(ready, counts, stage, sizes, on_step)
    penalties = [one.context.penalty(candidates.T[place]) for one, place in zip(ready, places, strict=True)]
    candidates = replace(candidates, scores=candidates.scores + torch.cat(penalties))
    admitted = [one.context.admits(candidates.T[place]) for one, place in zip(ready, places, strict=True)]
    host = PoseCandidates(candidates.T, candidates.scores).to("cpu")
    admitted_host, broken = torch.cat(admitted).cpu(), broken.cpu()
    left = []
    for one, place in zip(ready, places, strict=True):
        points = one.context.extremal_points
        left.append(survivors(host[place], admitted_host[place], stage, points) + place.start)
    kept = candidates[torch.cat(left).to(candidates.scores.device)]
    ends = [slice(*ends) for ends in pairwise([0, *accumulate(len(one) for one in left)])]
    whole = [not bool(broken[place].any()) for place in places]
    return [kept[end] if fine else _not_finite() for end, fine in zip(ends, whole, strict=True)]


def _all_refined(
    ready: Sequence[Descent], counts: Sequence[int], stage: Stage, sizes: Sizes, on_step: OnStep
) -> tuple[PoseCandidates, Tensor]:
    """The candidates of all pairs, one pair after the other, after the stage's iterations, and which of them met values
    that are not finite, (H,)."""
    surfaces = StackedSurfaces.of([one.surfaces for one in ready], stage.points)
    everything = PoseCandidates.cat([one.candidates for one in ready])
    size = sizes.poses(stage.points)
    parts = -(-len(everything) // size)
    settings, found, broken = _settings(ready, stage, everything), [], []
    for part in parts_of(counts, size, everything.scores.device):
        there, asked = surfaces.of_part(part), everything[part.rows]
        own_settings = _of_part(settings, part)
        if stage.keeps_scale:
            own_settings = replace(own_settings, scale=ScaleBounds.same(asked.T))
        some = refined(there.pair, asked, stage, own_settings, lambda: on_step(1.0 / parts))
        if not stage.widths:
            on_step(1.0 / parts)
        own = slice(0, size - part.filling)
        found.append(some[own])
        broken.append(there.faulty()[own])
    for one, count in zip(ready, counts, strict=True):
        _count(one.surfaces, count * (len(stage.widths) + 1))
    return PoseCandidates.cat(found), torch.cat(broken)


def _settings(ready: Sequence[Descent], stage: Stage, everything: PoseCandidates) -> Settings:
    """What may move, for each of the pairs (P,)."""
    like = everything.T.scale
    contexts = [one.context for one in ready]
    low, high, most = (
        like.new_tensor(values)
        for values in (
            [one.scale.low for one in contexts],
            [one.scale.high for one in contexts],
            [one.max_offset for one in contexts],
        )
    )
    is_open = all(one.scale.is_open for one in contexts)
    return Settings(stage.widest, ANY_SCALE if is_open else ScaleBounds(low, high), most, stage.normals)


def _of_part(settings: Settings, part: Part) -> Settings:
    """For each pose of the part."""
    scale, most = settings.scale, settings.max_offset
    if isinstance(scale, ScaleBounds):
        scale = ScaleBounds(scale.low[part.pairs], scale.high[part.pairs])
    return replace(settings, scale=scale, max_offset=most[part.pairs] if isinstance(most, Tensor) else most)


def _count(pair: SurfacePair, poses: int) -> None:
    """Add the evaluations of a pair's fields to its own counts: each field at each of the other's samples."""
    for model, samples in ((pair.scene, pair.object_samples), (pair.obj, pair.scene_samples)):
        counting = _counting(model)
        if counting is not None:
            counting.evaluations += poses * len(samples)


def _counting(model: DistanceModel) -> CountingField | None:
    field = model.field if isinstance(model, WorkingField) else None
    return field if isinstance(field, CountingField) else None


def _not_finite() -> InvalidInputError:
    return InvalidInputError("the field gives values that are not finite", reason="FIELD_NOT_FINITE")
