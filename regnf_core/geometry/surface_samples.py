"""Points on a surface with the normals there."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.geometry.bundle import Bundle
from regnf_core.geometry.sim3 import Sim3


@dataclass(frozen=True, eq=False)
class SurfaceSamples(Bundle):
    """Points on a field's zero level and the unit normals there. points, normals: (N, 3), field frame; points of a
    result are float64: a field may lie far from the origin."""

    points: Tensor
    normals: Tensor

    def __len__(self) -> int:
        return len(self.points)

    def subsample(self, limit: int, generator: torch.Generator) -> SurfaceSamples:
        """At most ``limit`` of the samples, chosen at random by the (CPU) generator, in their order."""
        if len(self) <= limit:
            return self
        return self[torch.randperm(len(self), generator=generator)[:limit].sort().values.to(self.points.device)]

    def transformed(self, T_target_own: Sim3) -> SurfaceSamples:
        """The samples in the frame that a single transform leads to, float64 on the CPU."""
        normals = self.normals.double().cpu() @ T_target_own.rotation.mT
        return SurfaceSamples(T_target_own.apply(self.points.double().cpu()), normals)
