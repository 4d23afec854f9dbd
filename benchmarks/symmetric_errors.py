"""Errors of an estimated T_object_scene against the true one, the smallest over the object's declared symmetries."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from regnf_core.geometry import metrics
from regnf_core.geometry.sim3 import Sim3

# An object's declared symmetries, in the form of the BOP benchmark: rotations that leave its shape unchanged.

_STEPS = 315  # BOP's: a point on the rim moves by at most 1 % of the diameter from one step to the next


@dataclass(frozen=True)
class ContinuousSymmetry:
    """Any turn about ``axis`` (3,) through ``offset`` (3,), object frame."""

    axis: Sequence[float]
    offset: Sequence[float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Symmetries:
    """Discrete: rigid 4x4 transforms of the object frame onto itself, identity left out. Continuous: whole axes."""

    discrete: Sequence[Sim3] = field(default_factory=list)
    continuous: Sequence[ContinuousSymmetry] = field(default_factory=list)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Symmetries:
        """From BOP's ``symmetries_discrete`` (16 numbers each, row-major) and ``symmetries_continuous`` (axis, offset).

        Lengths in object units. Raises ValueError, and InvalidInputError (INVALID_TRANSFORM).
        """
        try:
            discrete = [
                Sim3.from_matrix(torch.tensor(numbers, dtype=torch.float64).reshape(4, 4))
                for numbers in values.get("symmetries_discrete", [])
            ]
            continuous = [
                ContinuousSymmetry(_three(entry["axis"]), _three(entry.get("offset", (0.0, 0.0, 0.0))))
                for entry in values.get("symmetries_continuous", [])
            ]
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            raise ValueError(f"malformed symmetries: {error}") from error
        return cls(discrete, continuous)

    def transforms(self, steps: int = _STEPS) -> Sim3:
        """All symmetries as a batch (K,), the identity first: each discrete one with each step about each axis."""
        discrete = [Sim3.identity(), *self.discrete]
        turned = [Sim3.identity()]
        for symmetry in self.continuous:
            turned += [_turn(symmetry, 2 * math.pi * k / steps) for k in range(1, steps)]
        return Sim3.cat([turn @ fixed for fixed in discrete for turn in turned])


def _three(values: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = map(float, values)
    return x, y, z


def _turn(symmetry: ContinuousSymmetry, angle: float) -> Sim3:
    axis = torch.tensor(list(symmetry.axis), dtype=torch.float64)
    offset: Tensor = torch.tensor(list(symmetry.offset), dtype=torch.float64)
    if not axis.norm() > 1e-9:
        raise ValueError("a symmetry axis must not vanish")
    tangent = torch.cat([angle * axis / axis.norm(), torch.zeros(4, dtype=torch.float64)])
    return Sim3.from_translation(offset) @ Sim3.exp(tangent) @ Sim3.from_translation(-offset)


_CHUNK = 64  # symmetries treated at once by MSSD


def rotation_error(estimate: Sim3, truth: Sim3, symmetries: Symmetries | None = None) -> float:
    """Angle, radians, of the rotation between estimate and truth; the smallest over the symmetries."""
    S = (symmetries or Symmetries()).transforms()
    difference = Sim3(torch.ones_like(S.scale), estimate.rotation @ (S.rotation @ truth.rotation).mT, S.translation)
    return float(difference.log()[:, :3].norm(dim=-1).min())


def surface_displacement(estimate: Sim3, truth: Sim3, points: Tensor, symmetries: Symmetries) -> Tensor:
    """(K, N) distances between estimated and true place in the scene of object points (N, 3), for all K symmetries.

    In object units: scene distances times the true scale.
    """
    placed = estimate.inverse().apply(points.double())  # (N, 3)
    S = symmetries.transforms()
    true_back = truth.inverse()
    rows = []
    for start in range(0, len(S), _CHUNK):
        part = S[start : start + _CHUNK]
        rows.append((placed - true_back.apply(part.apply(points.double()))).norm(dim=-1))  # (k, N)
    return float(truth.scale) * torch.cat(rows)


def mssd(estimate: Sim3, truth: Sim3, points: Tensor, symmetries: Symmetries | None = None) -> float:
    """Maximum symmetry-aware surface distance over object points (N, 3), object units."""
    return float(surface_displacement(estimate, truth, points, symmetries or Symmetries()).amax(-1).min())


def errors_against_truth(
    estimate: Sim3, truth: Sim3, points: Tensor, symmetries: Symmetries | None = None, center: Tensor | None = None
) -> dict[str, float]:
    """As :func:`regnf_core.geometry.metrics.errors_against_truth`, of center, rotation and MSSD the smallest over the
    symmetries."""
    points, known = points.double().cpu(), symmetries or Symmetries()
    found = metrics.errors_against_truth(estimate, truth, points, center)
    size = max(metrics.diameter(points), 1e-12)
    middle = (points.mean(0) if center is None else center.double().cpu())[None]
    off = float(surface_displacement(estimate, truth, middle, known).min())
    largest = mssd(estimate, truth, points, known)
    return found | {
        "center_error": off / float(truth.scale),
        "center_error_share": off / size,
        "rotation_error_rad": rotation_error(estimate, truth, known),
        "mssd": largest,
        "mssd_share": largest / size,
    }
