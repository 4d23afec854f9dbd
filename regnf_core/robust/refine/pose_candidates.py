"""Pose candidates: a batch of poses with their scores, surface offsets, and the iterations that led to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from regnf_core.geometry.bundle import Bundle, over_tensors
from regnf_core.geometry.sim3 import Sim3


@dataclass(frozen=True, eq=False)
class Iterations(Bundle):
    """K iterations of H poses: T (H, K), robust costs (H, K), mean |residual| (H, K) of the scene's and of the object's
    samples, and of each the kernel width, all in object diameters, and the number of samples of each surface."""

    T: Sim3
    costs: Tensor
    residual_scene: Tensor
    residual_object: Tensor
    widths: tuple[float, ...]
    samples: tuple[int, ...]

    def then(self, more: Iterations) -> Iterations:
        """These, and the same poses' next ones."""
        columns = ((one.T, one.costs, one.residual_scene, one.residual_object) for one in (self, more))
        T, costs, of_scene, of_object = over_tensors(lambda *parts: torch.cat(parts, 1), *columns)
        widths, samples = self.widths + more.widths, self.samples + more.samples
        return Iterations(T, costs, of_scene, of_object, widths, samples)


@dataclass(frozen=True, eq=False)
class PoseCandidates(Bundle):
    """Poses T (H,), their scores (H,), 0..1, smaller is better, and their history: the iterations of these poses so
    far; None: there is none.

    offsets: (H,) float64, how much farther out the scene's surface lies than the object's, object diameters; None: the
    surfaces coincide.
    """

    T: Sim3
    scores: Tensor
    offsets: Tensor | None = None
    history: Iterations | None = None

    @classmethod
    def start(cls, T: Sim3, with_offsets: bool = False) -> PoseCandidates:
        """Poses that nothing is known of yet. With offsets: of 0."""
        return cls(T, torch.zeros_like(T.scale), torch.zeros_like(T.scale) if with_offsets else None)

    def __len__(self) -> int:
        return int(self.scores.numel())

    def split(self, size: int) -> list[PoseCandidates]:
        """Parts of at most ``size`` poses."""
        if len(self) <= size:
            return [self]
        return [self[part] for part in torch.split(torch.arange(len(self), device=self.scores.device), size)]

    def with_copies(self, count: int, spread: Sequence[float], generator: torch.Generator) -> PoseCandidates:
        """These, and ``count`` copies of each, moved at random: ``spread`` is the standard deviation of the rotation
        (radians), the translation and the log scale. Scores are those of the original. Drawn on the CPU."""
        origins = torch.arange(len(self), device=self.scores.device).repeat(count + 1)
        turn, shift, growth = spread
        deviations = torch.tensor([turn] * 3 + [shift] * 3 + [growth], dtype=torch.float64)
        steps = torch.randn(len(origins), 7, generator=generator, dtype=torch.float64) * deviations
        steps[: len(self)] = 0.0
        found = self[origins]
        return replace(found, T=found.T.perturb(steps.to(origins.device)))
