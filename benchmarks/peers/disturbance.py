"""What a method is given of the truth: poses and keypoints with noise of a stated size."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from regnf_core import Sim3


def disturbed(truth: Sim3, about: Tensor, degrees: float, shift: float, seed: int) -> Sim3:
    """T_object_scene turned by ``degrees`` about a random axis through ``about`` (3,), and shifted by ``shift``.

    Both in the object's frame and units; the axis and the shift's direction come from the seed. The scale stays
    the truth's.
    """
    generator = torch.Generator().manual_seed(seed)
    axis, direction = (_unit(torch.randn(3, generator=generator, dtype=torch.float64)) for _ in range(2))
    center = about.double().cpu()
    tangent = torch.cat([math.radians(degrees) * axis, torch.zeros(4)]).double()
    turn = Sim3.from_translation(center) @ Sim3.exp(tangent) @ Sim3.from_translation(-center)
    return Sim3.from_translation(shift * direction) @ turn @ truth


def keypoints(points: Tensor, truth: Sim3, count: int, noise: float, seed: int) -> tuple[Tensor, Tensor]:
    """``count`` points far apart on the scene's surface, and where a person would click them on the object.

    Taken from the scene's samples (N, 3), each the farthest from those before. Returns (count, 3) in the scene's frame
    and (count, 3) in the object's, with Gaussian noise of standard deviation ``noise`` (object units) on every
    coordinate. float64 on the CPU.
    """
    generator = torch.Generator().manual_seed(seed)
    all_points = points.double().cpu()
    chosen = [int(torch.randint(len(all_points), (1,), generator=generator))]
    distance = torch.full((len(all_points),), math.inf, dtype=torch.float64)
    while len(chosen) < count:
        distance = torch.minimum(distance, (all_points - all_points[chosen[-1]]).norm(dim=-1))
        chosen.append(int(distance.argmax()))
    in_scene = all_points[chosen]
    error = noise * torch.randn(in_scene.shape, generator=generator, dtype=torch.float64)
    return in_scene, truth.apply(in_scene) + error


def rigid_fit(source: Tensor, target: Tensor) -> Sim3:
    """The rotation and translation, no scale, that carry (N, 3) onto (N, 3) in least squares (Kabsch 1976)."""
    source_center, target_center = source.mean(0), target.mean(0)
    U, _, Vh = torch.linalg.svd((target - target_center).T @ (source - source_center))
    sign = torch.ones(3, dtype=source.dtype)
    sign[2] = torch.linalg.det(U) * torch.linalg.det(Vh)
    R = U @ torch.diag(sign) @ Vh
    return Sim3(torch.ones((), dtype=source.dtype), R, target_center - R @ source_center)


def _unit(vector: Tensor) -> Tensor:
    return vector / vector.norm()
