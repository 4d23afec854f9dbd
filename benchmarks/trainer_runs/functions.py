"""The trainers' functions in plain torch, from their published formulas: slow, of any precision, none of regnf's."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

_PRIMES = (1, 2654435761, 805459861)


@dataclass(frozen=True)
class GridLayout:
    """A multi-resolution hash grid as tiny-cuda-nn lays it out."""

    levels: int
    features: int
    log2_size: int
    base: int
    growth: float
    smoothstep: bool

    def scales(self) -> list[float]:
        """Cells along an edge, per level, in single precision as there."""
        log_growth = np.log2(np.float32(self.growth))
        one, base = np.float32(1), np.float32(self.base)
        return [float(np.exp2(np.float32(level) * log_growth) * base - one) for level in range(self.levels)]

    def nodes(self) -> list[int]:
        """Nodes along an edge, per level."""
        return [math.ceil(scale) + 1 for scale in self.scales()]

    def counts(self) -> list[int]:
        """Entries per level."""
        return [min(-(-(nodes**3) // 8) * 8, 1 << self.log2_size) for nodes in self.nodes()]


def hash_features(layout: GridLayout, table: Tensor, unit: Tensor, active: int | None = None) -> Tensor:
    """Features (N, levels x features) at points (N, 3) of the unit cube; levels from ``active`` on are zero."""
    parts, start = [], 0
    for level, (scale, nodes, count) in enumerate(zip(layout.scales(), layout.nodes(), layout.counts(), strict=True)):
        position = unit * scale + 0.5
        cell = position.detach().floor()
        share = position - cell
        if layout.smoothstep:
            share = share * share * (3 - 2 * share)
        total = torch.zeros(len(unit), layout.features, dtype=unit.dtype)
        for corner in range(8):
            bits = torch.tensor([corner & 1, corner >> 1 & 1, corner >> 2 & 1])
            weight = torch.where(bits.bool(), share, 1 - share).prod(dim=1)
            node = cell.long() + bits
            total = total + weight[:, None] * table[start + _row(node, nodes, count)]
        parts.append(total if active is None or level < active else total * 0)
        start += count
    return torch.cat(parts, dim=1)


def _row(node: Tensor, nodes: int, count: int) -> Tensor:
    if nodes**3 <= count:
        index = node[:, 0] + nodes * node[:, 1] + nodes * nodes * node[:, 2]
    else:
        index = torch.zeros(len(node), dtype=torch.long)
        for axis, prime in enumerate(_PRIMES):
            index ^= node[:, axis] * prime & 0xFFFFFFFF
    return index % count


def sines_by_frequency(x: Tensor, degree: int) -> Tensor:
    """[sin(2^0 x), cos(2^0 x), sin(2^1 x), ...], the order of NeuS, IDR and VolSDF."""
    parts = [wave(2.0**k * x) for k in range(degree) for wave in (torch.sin, torch.cos)]
    return torch.cat(parts, dim=1) if parts else x[:, :0]


def sines_by_axis(x: Tensor, degree: int, factor: float = 1.0) -> Tensor:
    """All sines, axis by axis, then all cosines: the order of sdfstudio and nerfstudio."""
    powers = torch.tensor([factor * 2.0**k for k in range(degree)], dtype=x.dtype)
    angles = (x[:, :, None] * powers).flatten(1)
    return torch.cat((torch.sin(angles), torch.sin(angles + math.pi / 2)), dim=1)


def softplus(x: Tensor) -> Tensor:
    """log(1 + exp(100 x)) / 100."""
    return torch.nn.functional.softplus(x, beta=100)


@dataclass
class Network:
    """Linear layers; ``skips``: layers that see [hidden, input] / sqrt 2."""

    weights: list[Tensor]
    biases: list[Tensor]
    skips: Sequence[int] = ()
    activation: Callable[[Tensor], Tensor] = softplus

    def __call__(self, x: Tensor) -> Tensor:
        hidden = x
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            if i in self.skips:
                hidden = torch.cat((hidden, x), dim=1) / math.sqrt(2)
            hidden = hidden @ weight.T + bias
            if i < len(self.weights) - 1:
                hidden = self.activation(hidden)
        return hidden

    def parameters(self) -> list[Tensor]:
        """All that is trained."""
        return [*self.weights, *self.biases]

    def double(self) -> Network:
        """The same in double precision."""
        return Network(_doubled(self.weights), _doubled(self.biases), self.skips, self.activation)


def _doubled(tensors: list[Tensor]) -> list[Tensor]:
    return [tensor.detach().double() for tensor in tensors]


def sphere_network(
    rng: np.random.Generator, widths: Sequence[int], plain: int, skips: Sequence[int] = (), bias: float = 0.5
) -> Network:
    """A network that begins as a sphere's distance (Atzmon and Lipman 2020); the first ``plain`` inputs are x, y, z."""
    weights, biases = [], []
    last = len(widths) - 2
    for i in range(last + 1):
        before, after = widths[i], widths[i + 1]
        if i + 1 in skips:
            after -= widths[0]
        weight = rng.normal(0, math.sqrt(2 / after), (after, before))
        if i == last:
            weight = rng.normal(math.sqrt(math.pi / before), 1e-4, (after, before))
            biases.append(np.full(after, -bias))
        else:
            biases.append(np.zeros(after))
        if i == 0:
            weight[:, plain:] = 0
        elif i in skips:
            weight[:, before - widths[0] + plain :] = 0
        weights.append(weight)
    return Network(_trainable(weights), _trainable(biases), skips)


def _trainable(arrays: list[np.ndarray]) -> list[Tensor]:
    return [torch.tensor(array, dtype=torch.float32, requires_grad=True) for array in arrays]


def new_table(rng: np.random.Generator, layout: GridLayout) -> Tensor:
    """Entries as tiny-cuda-nn begins with them: uniform in +-1e-4."""
    values = rng.uniform(-1e-4, 1e-4, (sum(layout.counts()), layout.features))
    return torch.tensor(values, dtype=torch.float32, requires_grad=True)


def growth_to(base: int, top: int, levels: int) -> float:
    """The growth from level to level with which the last has ``top`` nodes."""
    return math.exp((math.log(top) - math.log(base)) / max(levels - 1, 1))
