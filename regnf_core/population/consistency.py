"""Which placements can stand together: no surface explained twice, no matter shared, nothing behind floor or walls, one
size of each object.

Each placement has the probability p of its pose by itself. Sets of placements without conflict are compared by the
product of the odds p / (1 - p) of their members: a placement's probability among the others is the share of the sets
that hold it. Among placements that exclude each other, directly or through others, the odds count times the square of
the share of samples that each explains of what the largest does: a part of a large object is like many small ones.
The set that is chosen is the one of the most surface explained, each placement's weighted by how far its probability
is above the least one of an accepted answer: an integer program, solved exactly.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from regnf_core.library import LibraryObject
from regnf_core.population.placements import Placement, placed_samples
from regnf_core.population.proposals import Floats, Integers, Mask, SceneSurface

_SHARED_SURFACE = 0.25
"""Of the samples that the smaller of two placements explains: with more in common they explain the same surface."""
_DEEP, _DEEP_SHARE = 1.0, 0.02
"""Spacings that one placed surface may lie within another one or behind the boundary, but for so many samples."""
_SAME_SCALE = 1.1
"""Ratio of the scales of two placements of one object, at most: it has one size."""
_MOST_TOGETHER = 14
"""Placements that exclude each other, of which all sets are looked at; of more, the most probable."""


def distinct(placements: Sequence[Placement]) -> list[Placement]:
    """The most probable of those that put the same object onto the same surface."""
    kept: list[Placement] = []
    for one in sorted(placements, key=lambda each: -each.probability):
        if not any(one.number == other.number and _same_surface(one, other) for other in kept):
            kept.append(one)
    return kept


def _same_surface(one: Placement, other: Placement) -> bool:
    smaller = min(len(one.explains), len(other.explains))
    common = len(np.intersect1d(one.explains, other.explains, assume_unique=True))
    return common > _SHARED_SURFACE * max(smaller, 1)


def within_boundary(placement: Placement, library: Sequence[LibraryObject], surface: SceneSurface) -> bool:
    """Whether the placed object stands in front of floor and walls."""
    points = placed_samples(library[placement.number].model, placement.T_object_scene).numpy()
    return all((plane.height(points) < -_DEEP * surface.spacing).mean() <= _DEEP_SHARE for plane in surface.boundary)


def conflicts(placements: Sequence[Placement], library: Sequence[LibraryObject], spacing: float) -> Mask:
    """(K, K): which pairs cannot stand together."""
    count = len(placements)
    found = np.zeros((count, count), bool)
    points = [placed_samples(library[one.number].model, one.T_object_scene) for one in placements]
    ends = [(one.amin(0), one.amax(0)) for one in points]
    for a in range(count):
        for b in range(a):
            apart = bool((ends[a][0] > ends[b][1]).any() or (ends[b][0] > ends[a][1]).any())
            found[a, b] = found[b, a] = _of_two_sizes(placements[a], placements[b]) or (
                not apart
                and (
                    _same_surface(placements[a], placements[b])
                    or _enters(points[a], placements[b], library, spacing)
                    or _enters(points[b], placements[a], library, spacing)
                )
            )
    return found


def _of_two_sizes(one: Placement, other: Placement) -> bool:
    ratio = float(one.T_object_scene.scale / other.T_object_scene.scale)
    return one.number == other.number and max(ratio, 1.0 / ratio) > _SAME_SCALE


def _enters(points: torch.Tensor, other: Placement, library: Sequence[LibraryObject], spacing: float) -> bool:
    """Whether points (N, 3) of the scene lie deep within the other object."""
    T, one = other.T_object_scene, library[other.number]
    moved = T.apply(points)
    low, high = one.model.bounds
    inside = ((moved > low) & (moved < high)).all(-1)
    if not bool(inside.any()):
        return False
    depth = -one.field().signed_distance(moved[inside].float()).cpu()
    return float((depth > _DEEP * spacing * float(T.scale)).sum()) > _DEEP_SHARE * len(points)


def together(placements: Sequence[Placement], excluded: Mask, least: float) -> tuple[list[int], Floats]:
    """Numbers of the placements of the best set, and the probability (K,) of each among the others."""
    likely = np.array([one.probability for one in placements])
    among = likely.copy()
    groups = connected_components(csr_matrix(excluded), directed=False)[1] if len(placements) else []
    for group in range(max(groups, default=-1) + 1):
        members = np.flatnonzero(groups == group)
        if len(members) > 1:
            members = members[np.argsort(-likely[members])]
            rest, members = members[_MOST_TOGETHER:], members[:_MOST_TOGETHER]
            sizes = np.array([len(placements[number].explains) for number in members.tolist()])
            among[members] = shares(likely[members], sizes, excluded[np.ix_(members, members)])
            among[rest] = 0.0
    return _best_set(placements, excluded, among, least), among


def shares(likely: Floats, sizes: Integers, excluded: Mask) -> Floats:
    """The probability (K,) of each of a few placements, over all sets without conflict. sizes: (K,) samples that each
    explains."""
    odds = likely / np.maximum(1.0 - likely, 1e-6) * (sizes / max(sizes.max(), 1)) ** 2
    total, held = 0.0, np.zeros(len(odds))
    left: list[tuple[int, float, tuple[int, ...]]] = [(0, 1.0, ())]
    while left:
        number, weight, chosen = left.pop()
        if number == len(odds):
            total += weight
            held[list(chosen)] += weight
            continue
        left.append((number + 1, weight, chosen))
        if not excluded[number, list(chosen)].any():
            left.append((number + 1, weight * odds[number], (*chosen, number)))
    return held / total


def _best_set(placements: Sequence[Placement], excluded: Mask, likely: Floats, least: float) -> list[int]:
    worth = np.array([len(one.explains) for one in placements]) * (likely - least)
    able = np.flatnonzero(worth > 0)
    if not len(able):
        return []
    a, b = np.nonzero(np.triu(excluded[np.ix_(able, able)]))
    rows = np.arange(len(a))
    pairs = csr_matrix((np.ones(2 * len(a)), (np.tile(rows, 2), np.concatenate([a, b]))), (len(a), len(able)))
    limits = [LinearConstraint(pairs, ub=1)] if len(a) else []
    solved = milp(-worth[able], integrality=np.ones(len(able)), bounds=Bounds(0, 1), constraints=limits)
    chosen: list[int] = able[solved.x > 0.5].tolist()
    return chosen
