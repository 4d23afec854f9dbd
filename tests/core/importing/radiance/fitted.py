"""Densities of known shapes in hash grids, by the published formulas, one corner at a time; fitted by least squares.

The network behind the grid is linear: of each hidden neuron there is one with the opposite sign, and
relu(a) - relu(-a) = a. So the features that give wanted exponents solve a sparse linear system.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import lsqr

Doubles = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]
Shape = Callable[[Doubles], Doubles]
"""Signed distances (N,), positive in free space, of points (N, 3)."""
PRIMES = (1, 2654435761, 805459861)
STEEP = 150.0
"""The exponent falls so much per unit of distance from a surface."""
CLEAR = 9.0
"""Beyond plus and minus this, around where half of the light is stopped, it does not change."""


@dataclass(frozen=True)
class Grid:
    """A hash grid. tiny: as tiny-cuda-nn lays it out, else as nerfstudio's plain PyTorch does."""

    tiny: bool
    levels: int = 8
    features: int = 2
    log2: int = 15
    base: int = 8
    top: int = 220

    def scale(self, level: int) -> float:
        growth = (self.top / self.base) ** (1.0 / (self.levels - 1))
        cells = self.base * growth**level
        assert abs(cells - round(cells)) > 1e-3 or level in (0, self.levels - 1), "rounding would decide"
        if self.tiny:
            return cells - 1.0
        factor = np.exp((np.log(self.top) - np.log(self.base)) / (self.levels - 1))
        return float(torch.floor(self.base * factor ** torch.arange(self.levels))[level])  # the trainer's expression

    def nodes(self, level: int) -> int:
        """Along an edge, of tiny-cuda-nn's levels."""
        return math.ceil(self.scale(level) - 1e-6) + 1

    def entries(self, level: int) -> int:
        most = 1 << self.log2
        return min(most, -(-(self.nodes(level) ** 3) // 8) * 8) if self.tiny else most

    @property
    def rows(self) -> int:
        return sum(self.entries(level) for level in range(self.levels))

    def row(self, level: int, x: Any, y: Any, z: Any) -> Any:
        """Of a corner in the table: whole numbers of any size, or uint64."""
        first = sum(self.entries(below) for below in range(level))
        nodes, entries = self.nodes(level), self.entries(level)
        if self.tiny and nodes**3 <= entries:
            return first + (x + y * nodes + z * nodes**2) % entries
        mixed = (x * PRIMES[0]) ^ (y * PRIMES[1]) ^ (z * PRIMES[2])
        return first + (mixed % 2**32) % entries

    def corners(self, unit: Doubles) -> tuple[npt.NDArray[np.int64], Doubles]:
        """(N, L, 8): rows and weights of the corners around points of the unit cube."""
        rows = np.zeros((len(unit), self.levels, 8), np.int64)
        weights = np.zeros((len(unit), self.levels, 8))
        for level in range(self.levels):
            position = unit * self.scale(level) + (0.5 if self.tiny else 0.0)
            cell = np.floor(position)
            part = position - cell
            for number, corner in enumerate(itertools.product((0, 1), repeat=3)):
                weights[:, level, number] = np.prod(np.where(corner, part, 1.0 - part), axis=1)
                rows[:, level, number] = self.row(level, *(cell + corner).astype(np.uint64).T)
        return rows, weights


@dataclass(frozen=True, eq=False)
class Network:
    """Linear by its pairs of neurons. biased: as of plain PyTorch; tiny-cuda-nn has no biases."""

    first: Floats
    first_bias: Floats
    last: Floats
    last_bias: Floats

    @classmethod
    def random(cls, columns: int, biased: bool, width: int = 64, outputs: int = 16) -> Network:
        random = np.random.default_rng(5)
        half, bias = random.normal(size=(width // 2, columns)) / 4.0, random.normal(size=width // 2) * biased
        last = random.normal(size=(outputs, width)) / 4.0
        last[0, width // 2 :] = -last[0, : width // 2]
        parts = np.vstack([half, -half]), np.concatenate([bias, -bias]), last, random.normal(size=outputs) * biased
        return cls(*(part.astype(np.float32) for part in parts))

    def exponent(self, features: Doubles) -> Doubles:
        """(N,), as the trainers compute it."""
        hidden = np.maximum(features @ self.first.T.astype(np.float64) + self.first_bias, 0.0)
        return np.asarray(hidden @ self.last[0] + self.last_bias[0], np.float64)

    @property
    def factors(self) -> Doubles:
        """(L F,): the exponent's derivative by each feature."""
        half = len(self.first) // 2
        return np.asarray(self.last[0, :half].astype(np.float64) @ self.first[:half], np.float64)


@dataclass(frozen=True, eq=False)
class Fitted:
    """table: (rows, F)."""

    grid: Grid
    network: Network
    table: Floats

    def exponent(self, unit: Doubles) -> Doubles:
        """(N,), slowly: at points of the unit cube."""
        rows, weights = self.grid.corners(unit)
        features = (weights[..., None] * self.table[rows].astype(np.float64)).sum(axis=2)
        return self.network.exponent(features.reshape(len(unit), -1))

    def flat(self) -> Floats:
        """Network and grid in one vector, as tiny-cuda-nn keeps them."""
        return np.concatenate([self.network.first.ravel(), self.network.last.ravel(), self.table.ravel()])


def fitted(grid: Grid, shape: Shape, points: Doubles, unit: Doubles, factor: float, steps: int = 40) -> Fitted:
    """A grid whose density stops half of the light at the surface of a shape, on rays that meet it straight.

    points, unit: (N, 3), where, and the same places in the unit cube of the grid · factor: of the density.
    """
    network = Network.random(grid.levels * grid.features, biased=not grid.tiny)
    # The integral of factor exp(STEEP x + c), from minus infinity to 0, shall be log 2.
    shift = math.log(math.log(2.0) * STEEP / factor)
    wanted = shift + np.clip(-STEEP * shape(points), -CLEAR, CLEAR)
    rows, weights = grid.corners(unit)
    columns = grid.features * rows[..., None] + np.arange(grid.features)
    values = weights[..., None] * network.factors.reshape(1, grid.levels, 1, grid.features)
    starts = np.arange(len(points) + 1) * (columns.size // len(points))
    matrix = csr_matrix((values.ravel(), columns.ravel(), starts), (len(points), grid.features * grid.rows))
    constant = network.exponent(np.zeros((1, grid.levels * grid.features)))[0]
    found: Any = lsqr(matrix, wanted - constant, damp=1e-3, iter_lim=steps)[0]
    return Fitted(grid, network, found.reshape(-1, grid.features).astype(np.float32))


def boxes(*corners: tuple[list[float], list[float]]) -> Shape:
    """The union of boxes, each from its lowest to its highest corner."""

    def distance(points: Doubles) -> Doubles:
        found = np.full(len(points), np.inf)
        for low, high in corners:
            q = np.abs(points - np.add(low, high) / 2.0) - np.subtract(high, low) / 2.0
            found = np.minimum(found, np.linalg.norm(q.clip(0.0), axis=1) + q.max(axis=1).clip(max=0.0))
        return found

    return distance


def looking(place: Doubles, at: Doubles) -> Doubles:
    """(4, 4), camera to world, OpenGL's axes."""
    back = (place - at) / np.linalg.norm(place - at)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([right, np.cross(back, right), back], axis=1), place
    return pose


def ring(count: int, radius: float, height: float, at: Doubles) -> list[Doubles]:
    """Poses on a ring, at two heights, that look at a place."""
    turns = 2.0 * np.pi * np.arange(count) / count
    heights = height * (1.0 + 0.4 * (np.arange(count) % 2))
    return [
        looking(at + np.array([radius * np.cos(turn), radius * np.sin(turn), high]), at)
        for turn, high in zip(turns, heights, strict=True)
    ]
