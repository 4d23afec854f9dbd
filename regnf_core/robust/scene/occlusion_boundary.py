"""Occlusion boundaries: surface that a field shows where the space behind an observed surface begins.

A scene that was observed from one side is solid behind what was observed. The sides of that solid run along the lines
of sight; they are no real surface. If there is one point from which all surface in the box is seen from its front or
edge-on, the scene was observed from there alone, and edge-on surface is treated as an occlusion boundary. An object
that was observed from all sides has no such point: some of its faces point away from each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.robust.constants import OCCLUSION
from regnf_core.robust.samples import Samples


@dataclass(frozen=True, eq=False)
class SingleView:
    """A scene that was observed from one point, ``viewpoint`` (3,) float32: it is unobserved behind its surface."""

    viewpoint: Tensor

    def to(self, device: torch.device | str) -> SingleView:
        """The same for points on another device."""
        return SingleView(self.viewpoint.to(device))

    def unobserved(self, points: Tensor, values: Tensor) -> Tensor:
        """(M,) bool, where the signed distances (M,) are those of matter. points: not needed."""
        del points
        return values < 0.0

    def faces_unobserved(self, points: Tensor, normals: Tensor) -> Tensor:
        """(M,) bool: which surface elements at points (M, 3) with unit normals (M, 3) face away from the viewpoint."""
        return ((self.viewpoint - points) * normals).sum(-1) < 0.0


def occlusion_boundary(samples: Samples, generator: torch.Generator) -> tuple[Tensor, SingleView | None]:
    """(N,) bool: which samples lie on an occlusion boundary; and from where the scene was observed. None of both unless
    all was observed from one point."""
    points, normals = samples.on_surface().double(), samples.normals.double()
    viewpoint = _viewpoint(points, normals, generator)
    if viewpoint is None:
        return torch.zeros(len(samples), dtype=torch.bool), None
    edge_on: Tensor = _cosines(points, normals, viewpoint[None])[0].abs() < OCCLUSION.boundary_cosine
    return edge_on, SingleView(viewpoint.float()) if bool(edge_on.any()) else None


def _viewpoint(points: Tensor, normals: Tensor, generator: torch.Generator) -> Tensor | None:
    """(3,) from where all surface is seen from its front or edge-on; None where there is no such point."""
    guesses = _meeting_points(points, normals, generator)
    if guesses.shape[0] == 0:
        return None
    few = torch.randperm(points.shape[0], generator=generator)[: OCCLUSION.points]
    cosines = _cosines(points[few], normals[few], guesses)  # (K, J)
    away = (cosines < OCCLUSION.facing_away_cosine).double().mean(1)
    edge_on = (cosines.abs() < OCCLUSION.edge_on_cosine).double().mean(1)
    edge_on[away > OCCLUSION.max_facing_away] = 0.0
    best = int(edge_on.argmax())
    if edge_on[best] < OCCLUSION.min_edge_on:
        return None
    return _refined(guesses[best], points, normals)


def _meeting_points(points: Tensor, normals: Tensor, generator: torch.Generator) -> Tensor:
    """(K, 3) where the tangent planes of three random samples meet: the viewpoint, if all three are edge-on."""
    drawn = torch.randint(points.shape[0], (OCCLUSION.guesses, 3), generator=generator)
    planes = normals[drawn]  # (T, 3, 3)
    heights = (planes * points[drawn]).sum(-1)
    meeting = torch.linalg.det(planes).abs() > OCCLUSION.min_volume
    met: Tensor = torch.linalg.solve(planes[meeting], heights[meeting])
    return met[met.norm(dim=-1) < OCCLUSION.max_distance]


def _refined(viewpoint: Tensor, points: Tensor, normals: Tensor) -> Tensor:
    """The point (3,) nearest to the tangent planes of all edge-on samples, least squares."""
    for _ in range(OCCLUSION.refinements):
        edge_on = _cosines(points, normals, viewpoint[None])[0].abs() < OCCLUSION.edge_on_cosine
        n, p = normals[edge_on], points[edge_on]
        weight = 1.0 / (viewpoint - p).norm(dim=-1, keepdim=True)  # a plane's error grows with the distance
        heights = (n * p).sum(-1, keepdim=True)
        viewpoint = torch.linalg.lstsq(n * weight, heights * weight).solution[:, 0]
    return viewpoint


def _cosines(points: Tensor, normals: Tensor, viewpoints: Tensor) -> Tensor:
    """(K, N) cosines between the normals at points (N, 3) and the lines of sight to viewpoints (K, 3)."""
    along = viewpoints @ normals.T - (points * normals).sum(-1)
    squares = torch.addmm(points.square().sum(-1), viewpoints, points.T, alpha=-2.0)
    squares.add_(viewpoints.square().sum(-1, keepdim=True)).clamp_min_(torch.finfo(squares.dtype).tiny)
    cosines: Tensor = along.div_(squares.sqrt_())
    return cosines
