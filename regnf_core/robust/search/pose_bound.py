"""What is known of a pose: the object stands within the box, give or take, is not far smaller than it, and its scale is
within the caller's bounds."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3
from regnf_core.robust.constants import SEARCH
from regnf_core.robust.kernel import geman_mcclure_loss
from regnf_core.robust.search.scale_bound import ANY_SCALE, ScaleBound


@dataclass(frozen=True, eq=False)
class PoseBound:
    """Bounds the extent of the posed object by the detection box, and its scale. Working frames: the box's center is 0.

    points: (E, 3) outermost points of the object · axes: (3, 3) the box's, columns, scene frame · edges: (3,) of the
    box · tolerance: how far the object may reach beyond each of the box's faces, as a share of the edge. The edges of
    flat boxes count as SEARCH.min_face_distance there: a flat thing's field may be much thicker than its box ·
    scale: what the caller knows of it.
    """

    points: Tensor
    axes: Tensor
    edges: Tensor
    tolerance: float
    scale: ScaleBound = ANY_SCALE

    @classmethod
    def of(
        cls, detection: OrientedBox, extremal_points: Tensor, tolerance: float, scale: ScaleBound = ANY_SCALE
    ) -> PoseBound:
        """The bound for an object with these ``extremal_points`` (E, 3), on their device."""
        device = extremal_points.device
        axes, edges = detection.rotation.double().to(device), (detection.size / detection.diagonal).double().to(device)
        return cls(extremal_points.double(), axes, edges, tolerance, scale)

    def to(self, device: torch.device | str) -> PoseBound:
        """The same bound for poses on another device."""
        points, axes, edges = (part.to(device) for part in (self.points, self.axes, self.edges))
        return replace(self, points=points, axes=axes, edges=edges)

    def admits(self, T: Sim3) -> Tensor:
        """(H,) bool: which poses T (H,), scene to object, the detection allows."""
        placed = T.inverse().apply(self.points) @ self.axes  # (H, E, 3)
        low, high = placed.amin(-2), placed.amax(-2)
        reach = self.edges / 2 + self.tolerance * self._lengths
        within = (low >= -reach).all(-1) & (high <= reach).all(-1)
        size = ((high - low) / self._lengths).amax(-1)
        return within & (size >= SEARCH.min_share_of_detection)

    def penalty(self, T: Sim3) -> Tensor:
        """(H,): how badly the posed object fills the box, as a score: a Geman-McClure loss over the box's six faces."""
        placed = T.inverse().apply(self.points) @ self.axes  # (H, E, 3)
        off = torch.cat([placed.amin(-2) + self.edges / 2, placed.amax(-2) - self.edges / 2], -1)
        off = off / self._lengths.repeat(2)
        return SEARCH.box_weight * geman_mcclure_loss(off, SEARCH.box_width).mean(-1)

    @property
    def _lengths(self) -> Tensor:
        """(3,): what distances from the faces are compared with."""
        return self.edges.clamp_min(SEARCH.min_face_distance)

    def loosened(self, factor: float) -> PoseBound:
        """The bound with ``factor`` times the tolerance."""
        return replace(self, tolerance=factor * self.tolerance)
