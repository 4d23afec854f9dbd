"""Fields whose distance is known exactly: the ground truth of the pipeline's tests."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3


class AnalyticField:
    """A field from a formula; the gradient comes from autograd, so that it cannot disagree with the formula."""

    def __init__(self, formula: Callable[[Tensor], Tensor], bounds: Sequence[Sequence[float]]) -> None:
        self.formula = formula
        self._bounds = torch.as_tensor(bounds, dtype=torch.float64)

    @property
    def bounds(self) -> Tensor:
        return self._bounds

    @property
    def device(self) -> torch.device:
        return torch.device("cpu")

    def to(self, device: torch.device | str) -> AnalyticField:
        return self

    def signed_distance(self, points: Tensor) -> Tensor:
        with torch.no_grad():
            return self.formula(points.to(torch.float32))

    def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        with torch.enable_grad():
            leaf = points.detach().to(torch.float32).requires_grad_()
            distance = self.formula(leaf)
            (gradient,) = torch.autograd.grad(distance.sum(), leaf)
        return distance.detach(), gradient


def _unit_bounds() -> list[list[float]]:
    return [[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]


def sphere(
    radius: float, center: Sequence[float] = (0.0, 0.0, 0.0), bounds: Sequence[Sequence[float]] | None = None
) -> AnalyticField:
    def formula(points: Tensor) -> Tensor:
        return (points - torch.tensor(list(center), dtype=points.dtype)).norm(dim=-1) - radius

    return AnalyticField(formula, bounds or _unit_bounds())


def boxes(
    corners: Sequence[tuple[Sequence[float], Sequence[float]]], bounds: Sequence[Sequence[float]] | None = None
) -> AnalyticField:
    """A union of axis-aligned boxes given by (lowest corner, highest corner). Exact outside, a bound inside."""
    low = torch.tensor([pair[0] for pair in corners], dtype=torch.float32)  # (K, 3)
    high = torch.tensor([pair[1] for pair in corners], dtype=torch.float32)

    def formula(points: Tensor) -> Tensor:
        q = (points[:, None] - (low + high) / 2).abs() - (high - low) / 2  # (N, K, 3)
        outside = (q.clamp_min(0).square().sum(-1) + 1e-20).sqrt()
        return (outside + q.amax(-1).clamp_max(0)).amin(-1)

    return AnalyticField(formula, bounds or _unit_bounds())


def union(fields: Sequence[AnalyticField], bounds: Sequence[Sequence[float]] | None = None) -> AnalyticField:
    """The union of several fields of one frame."""

    def formula(points: Tensor) -> Tensor:
        return torch.stack([field.formula(points) for field in fields]).amin(0)

    return AnalyticField(formula, bounds or _unit_bounds())


def seen_from(
    field: AnalyticField, T_field_frame: Sim3, bounds: Sequence[Sequence[float]] | None = None
) -> AnalyticField:
    """``field`` in another frame: S_frame(x) = S_field(T x) / s, the distance in the other frame's own unit."""
    s = float(T_field_frame.scale)

    def formula(points: Tensor) -> Tensor:
        return field.formula(T_field_frame.apply(points)) / s

    return AnalyticField(formula, bounds or _unit_bounds())


def chair() -> AnalyticField:
    """A chair without symmetry, about 0.5 x 0.55 x 0.8, standing on z = -0.4: seat, back, four legs, one armrest."""
    return boxes(
        [
            ([-0.24, -0.25, -0.04], [0.24, 0.25, 0.02]),  # seat
            ([-0.24, 0.19, 0.02], [0.24, 0.25, 0.42]),  # back
            ([-0.24, -0.25, -0.40], [-0.18, -0.19, -0.04]),  # legs
            ([0.18, -0.25, -0.40], [0.24, -0.19, -0.04]),
            ([-0.24, 0.19, -0.40], [-0.18, 0.25, -0.04]),
            ([0.18, 0.19, -0.40], [0.24, 0.25, -0.04]),
            ([0.20, -0.25, 0.16], [0.30, 0.19, 0.22]),  # one armrest and its post
            ([0.20, -0.25, 0.02], [0.26, -0.19, 0.16]),
        ]
    )


def table() -> AnalyticField:
    """A round-edged stand-in for the wrong object: a slab on one thick foot."""
    return boxes([([-0.45, -0.3, 0.1], [0.45, 0.3, 0.16]), ([-0.08, -0.08, -0.3], [0.08, 0.08, 0.1])])


def room(T_object_scene: Sim3) -> AnalyticField:
    """A floor at z = 0, two walls, a side table, and the chair where T_object_scene says."""
    floor_and_walls = boxes(
        [
            ([-1.0, -1.0, -0.06], [1.0, 1.0, 0.0]),
            ([-1.0, -1.0, 0.0], [-0.94, 1.0, 0.9]),
            ([-1.0, 0.94, 0.0], [1.0, 1.0, 0.9]),
            ([0.35, 0.4, 0.0], [0.7, 0.75, 0.25]),
        ]
    )
    return union([floor_and_walls, seen_from(chair(), T_object_scene)])


def chair_pose(scale: float = 1.25, yaw: float = 0.6) -> Sim3:
    """T_object_scene of a chair that stands on the room's floor at about (-0.2, -0.15)."""
    half = torch.tensor(yaw / 2, dtype=torch.float64)
    quaternion = torch.stack([half * 0, half * 0, half.sin(), half.cos()])
    foot = torch.tensor([0.0, 0.0, -0.4 - 0.004], dtype=torch.float64)
    turned = Sim3.from_quaternion(scale, quaternion, [0.0, 0.0, 0.0])
    place = torch.tensor([[-0.2, -0.15, 0.0]], dtype=torch.float64)
    return Sim3(turned.scale, turned.rotation, foot - turned.apply(place)[0])


def chair_box(T_object_scene: Sim3) -> OrientedBox:
    """The axis-aligned detection of the chair in the scene."""
    corners = torch.cartesian_prod(*(torch.tensor(pair) for pair in ([-0.24, 0.3], [-0.25, 0.25], [-0.4, 0.42])))
    placed = T_object_scene.inverse().apply(corners.double())
    return OrientedBox.from_corners(placed.amin(0).tolist(), placed.amax(0).tolist())
