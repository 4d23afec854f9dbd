"""Surface of the scene within the object's hull that is no part of it: a cushion on a chair that should have none.

What stands close by, lies on top or carries the object touches it from outside of its convex hull: it says nothing
against the object. Within the hull, another object's surface may stand too (a chair under a table), but it faces the
object's own surface, which the scene shows as well. What lies on the object covers the object's surface, or its own
surface faces away from it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from regnf_core.geometry.sim3 import Sim3
from regnf_core.robust.constants import EVIDENCE
from regnf_core.robust.residuals import SurfacePair
from regnf_core.surface.projection import newton_step


def unexplained_samples(held_out: SurfacePair, T: Sim3, beyond: Tensor) -> Tensor:
    """(H, N) bool: which scene samples are unexplained at poses T (H,) between the working frames.

    beyond: (H, N) bool, samples outside of the object's surface, within its hull. They are unexplained unless they face
    that surface and the scene shows it.
    """
    A = held_out.scene_samples
    pose, sample = beyond.nonzero(as_tuple=True)
    unexplained = torch.zeros_like(beyond)
    if len(pose) == 0:
        return unexplained
    T = T.to(A.points)[pose]
    places = T.apply(A.points[sample][:, None])[:, 0]
    value, gradient = held_out.obj.value_and_gradient(places)
    slope = gradient.square().sum(-1).clamp_min(EVIDENCE.min_slope**2).sqrt()
    turned = (T.rotation @ A.normals[sample][..., None])[..., 0]
    away = (turned * gradient).sum(-1) >= EVIDENCE.facing_cosine * slope
    beneath = places - newton_step(value, gradient, EVIDENCE.min_slope)
    unexplained[pose, sample] = away | _covered(held_out, T, T.inverse().apply(beneath[:, None])[:, 0])
    return unexplained


def _covered(held_out: SurfacePair, T: Sim3, points: Tensor) -> Tensor:
    """(K,) bool: points (K, 3) of the scene's working frame that lie within matter, or were not observed."""
    value, _ = held_out.scene.value_and_gradient(points)
    value = T.scale * value
    covered: Tensor = value < -EVIDENCE.close
    unobserved = held_out.scene_samples.unobserved
    return covered if unobserved is None else covered | unobserved.unobserved(points, value)
