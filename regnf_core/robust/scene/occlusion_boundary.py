"""Where a scene ends because nobody looked further: the borders of shadows, told from surfaces that were seen.

A scene known from one side is solid behind what was seen, and the walls of that shadow run along the lines of sight.
They mean nothing. If there is one point from which every surface in the box is seen from its front, or edge-on, the
scene was seen from there alone, and what is edge-on is a shadow's wall. No object that was seen from all round allows
such a point: it has faces that look away from each other.
"""

from __future__ import annotations

import torch
from torch import Tensor

from regnf_core.robust.residuals import Samples

_TRIES = 3000
_JUDGED = 500  # samples that each guess is judged by
_EDGE_ON, _WALL = (
    0.05,
    0.10,
)  # cosines between normal and line of sight: while looking for the viewpoint, and at the end
_AWAY = -0.15  # a smaller cosine is a face that looks away
_MOST_AWAY = 0.04  # of the samples
_LEAST_EDGE_ON = 0.15  # of the samples: with fewer walls there is no shadow to speak of
_FARTHEST = 30.0  # working units
_LEAST_VOLUME = 0.05  # of three unit normals: planes closer to parallel meet anywhere
_REFINEMENTS = 3


def shadow_walls(samples: Samples, generator: torch.Generator) -> Tensor:
    """(N,) bool: which samples lie on the walls of a shadow; none unless all were seen from one point."""
    points, normals = samples.on_surface().double(), samples.normals.double()
    viewpoint = _viewpoint(points, normals, generator)
    if viewpoint is None:
        return torch.zeros(len(samples), dtype=torch.bool)
    walls: Tensor = _cosines(points, normals, viewpoint[None])[0].abs() < _WALL
    return walls


def behind_surfaces(_points: Tensor, values: Tensor) -> Tensor:
    """(M,) bool: what was seen from one side alone is not known behind its surface. values: signed distances (M,)."""
    return values < 0.0


def _viewpoint(points: Tensor, normals: Tensor, generator: torch.Generator) -> Tensor | None:
    """(3,) from where everything is seen from its front; None where there is no such point."""
    guesses = _meeting_points(points, normals, generator)
    if guesses.shape[0] == 0:
        return None
    some = torch.randperm(points.shape[0], generator=generator)[:_JUDGED]
    cosines = _cosines(points[some], normals[some], guesses)  # (K, J)
    away = (cosines < _AWAY).double().mean(1)
    edge_on = (cosines.abs() < _EDGE_ON).double().mean(1)
    edge_on[away > _MOST_AWAY] = 0.0
    best = int(edge_on.argmax())
    if edge_on[best] < _LEAST_EDGE_ON:
        return None
    return _refined(guesses[best], points, normals)


def _meeting_points(points: Tensor, normals: Tensor, generator: torch.Generator) -> Tensor:
    """(K, 3) where the tangent planes of three random samples meet: at the viewpoint, if all three are walls."""
    drawn = torch.randint(points.shape[0], (_TRIES, 3), generator=generator)
    planes = normals[drawn]  # (T, 3, 3)
    heights = (planes * points[drawn]).sum(-1)
    sound = torch.linalg.det(planes).abs() > _LEAST_VOLUME
    met: Tensor = torch.linalg.solve(planes[sound], heights[sound])
    return met[met.norm(dim=-1) < _FARTHEST]


def _refined(viewpoint: Tensor, points: Tensor, normals: Tensor) -> Tensor:
    """The point nearest to the tangent planes of all walls, least squares."""
    for _ in range(_REFINEMENTS):
        walls = _cosines(points, normals, viewpoint[None])[0].abs() < _EDGE_ON
        n, p = normals[walls], points[walls]
        weight = 1.0 / (viewpoint - p).norm(dim=-1, keepdim=True)  # a plane's error grows with the way to it
        heights = (n * p).sum(-1, keepdim=True)
        viewpoint = torch.linalg.lstsq(n * weight, heights * weight).solution[:, 0]
    return viewpoint


def _cosines(points: Tensor, normals: Tensor, viewpoints: Tensor) -> Tensor:
    """(K, N) cosines between the normals at points (N, 3) and the ways to viewpoints (K, 3)."""
    way = viewpoints[:, None] - points
    cosines: Tensor = (way * normals).sum(-1) / way.norm(dim=-1).clamp_min(1e-9)
    return cosines
