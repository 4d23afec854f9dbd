"""Samples of a surface, and what tells where a scene was not observed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor


class UnobservedTest(Protocol):
    """Tells what was not observed of a scene, in the samples' frame."""

    def unobserved(self, points: Tensor, values: Tensor) -> Tensor:
        """(M,) bool: which of the points (M, 3) were not observed. values: (M,) the signed distances there, object
        diameters."""
        ...

    def faces_unobserved(self, points: Tensor, normals: Tensor) -> Tensor:
        """(M,) bool: which surface elements at points (M, 3) with unit normals (M, 3) nobody can have seen, because the
        space in front of them was not seen to be free."""
        ...

    def to(self, device: torch.device | str) -> UnobservedTest:
        """The same for points on another device."""
        ...


@dataclass(frozen=True, eq=False)
class Samples:
    """Points near a surface: points (N, 3), the field's value there (N,), its unit normals (N, 3). float32.

    unobserved: where the field shows something that was not observed; None: everything was observed · shares: (N,), the
    weight of each sample where the mean over all is taken, their sum 1; None: all weigh the same · hidden: (N,) bool,
    samples of a scene that nobody can have seen from their front; they tell nothing where the object faces another way.

    Where each pose of a batch has samples of its own, all tensors have one more dimension in front.
    """

    points: Tensor
    values: Tensor
    normals: Tensor
    unobserved: UnobservedTest | None = None
    shares: Tensor | None = None
    hidden: Tensor | None = None

    def __len__(self) -> int:
        return int(self.points.shape[-2])

    def __getitem__(self, index: Tensor) -> Samples:
        shares, hidden = (None if part is None else part[index] for part in (self.shares, self.hidden))
        return Samples(self.points[index], self.values[index], self.normals[index], self.unobserved, shares, hidden)

    def to(self, device: torch.device | str) -> Samples:
        """The same samples on another device."""
        points, values, normals = (part.to(device) for part in (self.points, self.values, self.normals))
        shares, hidden = (None if part is None else part.to(device) for part in (self.shares, self.hidden))
        unobserved = None if self.unobserved is None else self.unobserved.to(device)
        return Samples(points, values, normals, unobserved, shares, hidden)

    def on_surface(self) -> Tensor:
        """The points (N, 3) moved onto the surface along their normals."""
        return self.points - self.values.unsqueeze(-1) * self.normals


def fixed_generator() -> torch.Generator:
    """A new generator for what is the same in every registration, whatever its seed."""
    return torch.Generator().manual_seed(0)


def subsample(samples: Samples, limit: int, generator: torch.Generator) -> Samples:
    """At most ``limit`` of the samples, at random: drawn on the CPU, so that a seed means the same on every device."""
    if len(samples) <= limit:
        return samples
    drawn = torch.randperm(len(samples), generator=generator)[:limit]
    return samples[drawn.to(samples.points.device)]


def split(samples: Samples, held_out: float, generator: torch.Generator) -> tuple[Samples, Samples]:
    """Two disjoint random parts; the second, a share ``held_out`` (0..1), is for the verdict alone."""
    order = torch.randperm(len(samples), generator=generator).to(samples.points.device)
    cut = len(samples) - int(held_out * len(samples))
    return samples[order[:cut]], samples[order[cut:]]
