"""Residuals between two fields under a transform. Unlike those of the published loss, they keep the scale.

Under x_object = T x the two fields describe one surface when S_object(T x) = s S_scene(x).
"""

from __future__ import annotations

import torch
from torch import Tensor

from regnf_core.fields.base import SdfField
from regnf_core.geometry.sim3 import Sim3


def scene_residuals(scene: SdfField, obj: SdfField, points: Tensor, T_object_scene: Sim3) -> Tensor:
    """S_object(T x) - s S_scene(x) (N,), object units, at points x (N, 3) of the scene frame."""
    moved = obj.signed_distance(T_object_scene.apply(points)).to(points)
    return moved - float(T_object_scene.scale) * scene.signed_distance(points).to(points)


def object_residuals(scene: SdfField, obj: SdfField, points: Tensor, T_object_scene: Sim3) -> Tensor:
    """s S_scene(T^-1 z) - S_object(z) (N,), object units, at points z (N, 3) of the object frame.

    Positive: the scene is free where the object should be. Negative: the scene holds more matter there.
    """
    moved = scene.signed_distance(T_object_scene.inverse().apply(points)).to(points)
    return float(T_object_scene.scale) * moved - obj.signed_distance(points).to(points)


def mean_residual(
    scene: SdfField, obj: SdfField, scene_points: Tensor, object_points: Tensor, T_object_scene: Sim3, cap: float
) -> float:
    """Mean |residual| of both directions, each at most ``cap`` (object units): a score, smaller is better."""
    scene_to_object = scene_residuals(scene, obj, scene_points, T_object_scene).abs()
    object_to_scene = object_residuals(scene, obj, object_points, T_object_scene).abs()
    return float(torch.cat([scene_to_object, object_to_scene.to(scene_to_object)]).clamp_max(cap).mean())
