"""Samples of a surface, and what tells where a scene was not observed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor


class UnobservedTest(Protocol):
    """Tells what was not observed of a scene, in the samples' frame."""

    def unobserved(self, points: Tensor, values: Tensor) -> Tensor:
        """(M,) bool: which of the points (M, 3), with these signed distances (M,), were not observed."""
        ...

    def faces_unobserved(self, points: Tensor, normals: Tensor) -> Tensor:
        """(M,) bool: which surface elements at points (M, 3) with unit normals (M, 3) nobody can have seen, because the
        space in front of them was not seen to be free."""
        ...


@dataclass(frozen=True, eq=False)
class Samples:
    """Points near a surface: points (N, 3), the field's value there (N,), its unit normals (N, 3). float32, CPU.

    unobserved: where the field shows something that was not observed; None: everything was observed.
    """

    points: Tensor
    values: Tensor
    normals: Tensor
    unobserved: UnobservedTest | None = None

    def __len__(self) -> int:
        return int(self.points.shape[0])

    def __getitem__(self, index: Tensor) -> Samples:
        return Samples(self.points[index], self.values[index], self.normals[index], self.unobserved)

    def on_surface(self) -> Tensor:
        """The points (N, 3) moved onto the surface along their normals."""
        return self.points - self.values.unsqueeze(-1) * self.normals


def subsample(samples: Samples, limit: int, generator: torch.Generator) -> Samples:
    """At most ``limit`` of the samples, at random."""
    if len(samples) <= limit:
        return samples
    return samples[torch.randperm(len(samples), generator=generator)[:limit]]


def split(samples: Samples, held_out: float, generator: torch.Generator) -> tuple[Samples, Samples]:
    """Two disjoint random parts; the second, a share ``held_out`` (0..1), is for the verdict alone."""
    order = torch.randperm(len(samples), generator=generator)
    cut = len(samples) - int(held_out * len(samples))
    return samples[order[:cut]], samples[order[cut:]]
