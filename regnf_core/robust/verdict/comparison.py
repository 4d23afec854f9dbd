"""Two candidate objects at one place: which surface tells them apart, whether it was seen, and which one it speaks for.

Objects of a kind agree with the scene where they are alike. Only the surface where they differ decides: of either
object, what lies off the other's surface. The scene may show it, show that it is not there, or not have seen it.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.document import ABSENT, SHOWN, UNKNOWN, DecidingSurface, Difference
from regnf_core.geometry.sim3 import Sim3
from regnf_core.geometry.surface_samples import SurfaceSamples
from regnf_core.robust.constants import EVIDENCE, VERDICT
from regnf_core.robust.problem import RegistrationProblem
from regnf_core.robust.residuals import Residuals, residuals


@dataclass(frozen=True, eq=False)
class Placed:
    """A candidate at its pose T (single), between the working frames, with its surface offset (1,)."""

    problem: RegistrationProblem
    T: Sim3
    offset: Tensor

    def residuals(self) -> Residuals:
        """Of the held-out samples."""
        points = self.problem.held_out.scene_samples.points
        return residuals(self.problem.held_out, self.T[None].on(points.device), self.offset.to(points))

    def on_other(self, other: Placed) -> Tensor:
        """(M,): how far the held-out samples lie from the surface of the other candidate, in its diameters."""
        points = self.problem.held_out.object_samples.points
        places = other.T.apply(self.T.apply_inverse(points.double()))
        return other.problem.held_out.obj.value_and_gradient(places.to(points))[0].abs()

    def in_scene(self) -> SurfaceSamples:
        """The held-out samples where the pose puts them, in the scene's own frame, on the CPU."""
        samples = self.problem.held_out.object_samples
        own = SurfaceSamples(self.problem.model.frame.out_of(samples.points), samples.normals)
        return own.transformed(self.problem.in_field_frames(self.T).inverse())


@dataclass(frozen=True)
class Comparison:
    """What tells two candidates of one view apart, in numbers, and the surface that these are of."""

    difference: Difference
    surface: DecidingSurface


def compare(one: Placed, other: Placed) -> Comparison:
    """Evaluates both objects' fields at each other's samples."""
    sides = [_Side.of(one, other), _Side.of(other, one)]
    count = sum(len(side.differs) for side in sides)
    differs = sum(int(side.differs.sum()) for side in sides)
    seen = sum(int((side.shown | side.absent).sum()) for side in sides)
    # What is there of the one and what is not there of the other speak for the one.
    for_one, for_other = (int(mine.shown.sum()) + int(its.absent.sum()) for mine, its in (sides, sides[::-1]))
    favor = (for_one - for_other) / max(seen, 1)
    found = Difference(differs / count, seen / count, favor, seen >= VERDICT.min_deciding * count)
    parts = [placed.in_scene()[side.differs] for placed, side in zip((one, other), sides, strict=True)]
    of_other = torch.cat([torch.full((len(part),), of_it) for part, of_it in zip(parts, (False, True), strict=True)])
    states = torch.cat([side.states()[side.differs] for side in sides])
    return Comparison(found, DecidingSurface(SurfaceSamples.cat(parts), of_other, states, found.distinguishable))


def decides_for_other(found: Difference) -> bool:
    """Whether the observed surface clearly supports the other candidate: the two have the same place and differ in
    parts."""
    return found.distinguishable and found.differs <= VERDICT.most_differing and found.favor <= -VERDICT.min_favor


@dataclass(frozen=True, eq=False)
class _Side:
    """Of one candidate's samples (M,) bool: which lie off the other's surface, and which of these the scene shows, or
    shows not to be there."""

    differs: Tensor
    shown: Tensor
    absent: Tensor

    @classmethod
    def of(cls, mine: Placed, other: Placed) -> _Side:
        r = mine.residuals().on("cpu")
        n = r.scene_count
        value, cosine = r.object_to_scene[0], r.cosines[0, n:]
        observed = torch.ones_like(value, dtype=torch.bool) if r.unobserved is None else ~r.unobserved[0, n:]
        differs = mine.on_other(other).cpu() > EVIDENCE.agreement
        shown = differs & observed & (value.abs() <= EVIDENCE.close) & (cosine >= EVIDENCE.min_inlier_cosine)
        return cls(differs, shown, differs & observed & (value > EVIDENCE.agreement))

    def states(self) -> Tensor:
        """(M,) uint8, as in :class:`regnf_core.document.DecidingSurface`."""
        unknown = torch.full_like(self.shown, UNKNOWN, dtype=torch.uint8)
        return unknown.masked_fill(self.shown, SHOWN).masked_fill(self.absent, ABSENT)
