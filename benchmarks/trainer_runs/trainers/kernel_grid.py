"""The hash grid of torch-ngp's kernel, by which MonoSDF trains: tables in double precision, rows in single."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

_PRIMES = (1, 2654435761, 805459861)


@dataclass(frozen=True)
class KernelGrid:
    """``top``: the finest resolution."""

    levels: int
    features: int
    log2_size: int
    base: int
    top: int
    smoothstep: bool

    @property
    def growth(self) -> float:
        """From level to level."""
        return float(np.exp2(np.log2(self.top / self.base) / (self.levels - 1)))

    def counts(self) -> list[int]:
        """Entries per level: (resolution + 1)^3, at most 2^log2_size."""
        resolutions = [math.ceil(self.base * self.growth**level) for level in range(self.levels)]
        return [min(1 << self.log2_size, (resolution + 1) ** 3) for resolution in resolutions]

    def scales(self) -> list[float]:
        """Cells along an edge, per level, in the kernel's single precision."""
        log_growth, one, base = np.float32(np.log2(self.growth)), np.float32(1), np.float32(self.base)
        return [float(np.exp2(np.float32(level) * log_growth) * base - one) for level in range(self.levels)]


def new_kernel_table(rng: np.random.Generator, grid: KernelGrid) -> Tensor:
    """Entries as the trainer begins with them."""
    values = rng.uniform(-1e-4, 1e-4, (sum(grid.counts()), grid.features))
    return torch.tensor(values, dtype=torch.float32, requires_grad=True)


def kernel_features(grid: KernelGrid, table: Tensor, unit: Tensor) -> Tensor:
    """Features (N, levels x features) at points (N, 3) of the unit cube."""
    parts, start = [], 0
    for scale, count in zip(grid.scales(), grid.counts(), strict=True):
        row = math.ceil(scale) + 2
        position = unit * scale + 0.5
        cell = position.detach().floor()
        share = position - cell
        if grid.smoothstep:
            share = share * share * (3 - 2 * share)
        total = torch.zeros(len(unit), grid.features, dtype=unit.dtype)
        for corner in range(8):
            bits = torch.tensor([corner & 1, corner >> 1 & 1, corner >> 2 & 1])
            weight = torch.where(bits.bool(), share, 1 - share).prod(dim=1)
            total = total + weight[:, None] * table[start + _entry(cell.long() + bits, row, count)]
        parts.append(total)
        start += count
    return torch.cat(parts, dim=1)


def _entry(node: Tensor, row: int, count: int) -> Tensor:
    if row**3 <= count:
        return (node[:, 0] + row * node[:, 1] + row * row * node[:, 2]) % count
    index = torch.zeros(len(node), dtype=torch.long)
    for axis, prime in enumerate(_PRIMES):
        index ^= node[:, axis] * prime & 0xFFFFFFFF
    return index % count
