"""Errors of an estimated T_object_scene against the true one.

Three are the paper's (and nerf2nerf's). The others are the error of the object's center, a rotation error that does not
depend on the choice of angles, and distances between true and estimated surface points, the smallest over the declared
symmetries.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from regnf_core.geometry.euler import euler_from_rotation
from regnf_core.geometry.points import NearestNeighbors, diameter
from regnf_core.geometry.sim3 import Sim3
from regnf_core.geometry.symmetry import Symmetries

_CHUNK = 64  # symmetries treated at once by MSSD


def translation_rmse(estimate: Sim3, truth: Sim3) -> float:
    """Root mean square over x, y, z of the difference of the translations, object units."""
    return float((estimate.translation - truth.translation).square().mean().sqrt())


def euler_rmse(estimate: Sim3, truth: Sim3) -> float:
    """Root mean square over roll, pitch, yaw of their differences, each wrapped to +-pi, radians."""
    difference = euler_from_rotation(estimate.rotation) - euler_from_rotation(truth.rotation)
    wrapped = torch.remainder(difference + math.pi, 2 * math.pi) - math.pi
    return float(wrapped.square().mean().sqrt())


def scale_error(estimate: Sim3, truth: Sim3) -> float:
    """|s - s_true|."""
    return float((estimate.scale - truth.scale).abs())


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


def add_s(estimate: Sim3, truth: Sim3, points: Tensor) -> float:
    """ADD-S: mean distance from true to the nearest estimated surface point, object points (N, 3), object units."""
    placed = estimate.inverse().apply(points.double())
    distance, _ = NearestNeighbors(placed).query(truth.inverse().apply(points.double()))
    return float(truth.scale) * float(distance.mean())


def paper_errors(estimate: Sim3, truth: Sim3) -> dict[str, float]:
    """The paper's errors by name. The translation's grows with the distance of the scene's origin from the object: it
    holds the rotation's lever arm."""
    return {
        "translation_rmse": translation_rmse(estimate, truth),
        "euler_rmse_rad": euler_rmse(estimate, truth),
        "scale_error": scale_error(estimate, truth),
    }


def errors_against_truth(
    estimate: Sim3,
    truth: Sim3,
    points: Tensor,
    symmetries: Symmetries | None = None,
    center: Tensor | None = None,
) -> dict[str, float]:
    """The errors by name that do not depend on where the scene's origin is, the smallest over the symmetries.

    points: (N, 3), surface points of the object, object frame · center: (3,), of the object; None: the points' mean.
    ``center_error`` is in scene units, ``mssd`` and ``add_s`` are in object units. ``_share`` means: of the object's
    diameter, or, for the scale, of the true scale.
    """
    points, known = points.double().cpu(), symmetries or Symmetries()
    size = max(diameter(points), 1e-12)
    middle = (points.mean(0) if center is None else center.double().cpu())[None]
    off = float(surface_displacement(estimate, truth, middle, known).min())
    largest, nearest = mssd(estimate, truth, points, known), add_s(estimate, truth, points)
    return {
        "center_error": off / float(truth.scale),
        "center_error_share": off / size,
        "rotation_error_rad": rotation_error(estimate, truth, known),
        "scale_error_share": scale_error(estimate, truth) / float(truth.scale),
        "mssd": largest,
        "mssd_share": largest / size,
        "add_s": nearest,
        "add_s_share": nearest / size,
    }
