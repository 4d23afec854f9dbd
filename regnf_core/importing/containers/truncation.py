"""How many voxels the value 1 of a map of truncated distances stands for, as far as the values tell.

Fused distances are projective: measured along the camera's axis, so never below the distance to the surface but for
noise and the image's corners, and equal to it where a camera faced the surface. So the largest ratios of distance to
value tell, for the side of the surface that was faced best; slopes at the surface, 1 / cos of the incidence, do not. Of
a scan whose cameras faced nothing the ratios say too little: they tell the least that the truncation can be.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from regnf_core.importing.arrays import Float32Array

BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]
Float64Array = npt.NDArray[np.float64]

USUAL = 8.0
"""Open3D's default of ``trunc_voxel_multiplier``."""
CANDIDATES = (4.0, 5.0, 6.0, 8.0, 10.0, 12.0, 16.0, 20.0)
_LOW, _HIGH = 0.3, 0.9
"""Values between which a voxel is neither at the surface nor cut off in some of the images."""
_FACED, _OF_A_SIDE = 0.9, 300
"""Share of a side's voxels that were seen more aslant than those that tell, and how many there must be."""
_BLOCKS, _VOXELS, _FEWEST = 1_500, 20_000, 200
_STEEP = 0.6
"""A larger step from one voxel to the next is a jump between two surfaces."""
_EVEN, _ROUND = 1.12, 0.05
"""Ratios as even as this, on a surface with normals to all sides, are of distances that are not projective."""
_USUAL_RANGE = (0.8, 1.2)
"""Of fused maps of rooms at the usual truncation the evidence is 0.98 to 1.04 of it, of things on a floor that were
looked down at 0.81 to 0.91, of a coarse and noisy one 1.17."""
_NEAR_CANDIDATE = 0.05


@dataclass(frozen=True)
class TruncationEvidence:
    """``voxels``: by the voxels that were faced; None: too little surface. exact: distances are not projective."""

    voxels: float | None
    exact: bool = False

    @property
    def settled(self) -> float | None:
        """The truncation, voxels, where the values leave no doubt of it."""
        if self.voxels is None or not self.exact:
            return None
        best = self.nearest
        return best if abs(self.voxels / best - 1.0) <= _NEAR_CANDIDATE else None

    @property
    def allows_usual(self) -> bool:
        """Whether the values agree with the usual truncation, or tell nothing."""
        if self.voxels is None:
            return True
        return not self.exact and _USUAL_RANGE[0] <= self.voxels / USUAL <= _USUAL_RANGE[1]

    @property
    def nearest(self) -> float:
        """The candidate nearest to the evidence."""
        found = USUAL if self.voxels is None else self.voxels
        return min(CANDIDATES, key=lambda voxels: abs(np.log(voxels / found)))


def truncation_evidence(values: Float32Array, weights: Float32Array, blocks: IntArray) -> TruncationEvidence:
    """values: (B, R, R, R), cut off at 1 · weights: as many, 0 where nothing was seen · blocks: (B, 3)."""
    values, weights, blocks = _neighborhood(values, weights, blocks)
    seen = weights > 0
    surface, normals = _crossings(values, seen, blocks)
    well_seen = weights >= np.median(weights[seen])
    chosen = np.argwhere(well_seen & (np.abs(values) > _LOW) & (np.abs(values) < _HIGH))
    if len(surface) < _FEWEST or len(chosen) < _FEWEST:
        return TruncationEvidence(None)
    if len(chosen) > _VOXELS:
        chosen = chosen[np.random.default_rng(0).choice(len(chosen), _VOXELS, replace=False)]
    places = (values.shape[1] * blocks[chosen[:, 0]] + chosen[:, 1:]).astype(np.float64)
    distance, nearest = cKDTree(surface).query(places)
    value = values[tuple(chosen.T)].astype(np.float64)
    ratios = distance / np.abs(value)
    low, high = np.quantile(ratios, [0.1, 0.9])
    spread = np.linalg.eigvalsh(normals.T @ normals / len(normals))
    even = bool(high <= _EVEN * low and spread[0] >= _ROUND)
    if even:
        return TruncationEvidence(float(np.median(ratios)), exact=True)
    return TruncationEvidence(_best_faced(ratios, (places - surface[nearest]) * np.sign(value)[:, None]))


def _best_faced(ratios: Float64Array, outward: Float64Array) -> float:
    """The high ratios (N,) of the side that has the highest. outward: (N, 3) from the surface, of any length."""
    sides = np.array([side for side in product((-1.0, 0.0, 1.0), repeat=3) if any(side)])
    sides /= np.linalg.norm(sides, axis=1, keepdims=True)
    side = (outward @ sides.T).argmax(axis=1)
    many = [ratios[side == number] for number in range(len(sides))]
    found = [np.quantile(of_side, _FACED) for of_side in many if len(of_side) >= _OF_A_SIDE]
    return float(max(found, default=np.quantile(ratios, _FACED)))


def _neighborhood(
    values: Float32Array, weights: Float32Array, blocks: IntArray
) -> tuple[Float32Array, Float32Array, IntArray]:
    """So many blocks near one another, if there are more."""
    if len(blocks) <= _BLOCKS:
        return values, weights, blocks
    middle = blocks[np.random.default_rng(0).integers(len(blocks))]
    nearest = np.sort(np.argsort(np.square(blocks - middle).sum(axis=1), kind="stable")[:_BLOCKS])
    return values[nearest], weights[nearest], blocks[nearest]


def _crossings(values: Float32Array, seen: BoolArray, blocks: IntArray) -> tuple[Float64Array, Float64Array]:
    """Where the values cross zero between neighbors (N, 3), in voxels, and unit gradients near them (M, 3)."""
    found: list[Float64Array] = []
    for axis in (1, 2, 3):
        here, beyond = (values.take(range(a, values.shape[axis] - 1 + a), axis) for a in (0, 1))
        both = seen.take(range(values.shape[axis] - 1), axis) & seen.take(range(1, values.shape[axis]), axis)
        crossing = np.argwhere(both & ((here < 0) != (beyond < 0)) & (np.abs(here - beyond) < _STEEP))
        at = tuple(crossing.T)
        places = (values.shape[1] * blocks[crossing[:, 0]] + crossing[:, 1:]).astype(np.float64)
        places[:, axis - 1] += here[at] / (here[at] - beyond[at])
        found.append(places)
    here = values[:, :-1, :-1, :-1]
    steps = [values[:, 1:, :-1, :-1] - here, values[:, :-1, 1:, :-1] - here, values[:, :-1, :-1, 1:] - here]
    near = (np.abs(here) < _LOW) & seen[:, :-1, :-1, :-1]
    normals = np.stack([step[near] for step in steps], axis=1).astype(np.float64)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    return np.concatenate(found), normals
