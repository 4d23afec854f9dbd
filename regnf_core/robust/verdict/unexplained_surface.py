"""Surface of the scene that is joined to the object and no part of it: a cushion on a chair that should have none.

Objects that stand close by have surface near the object too, but it faces the object's own surface, which the scene
shows as well. Something that lies on the object covers the object's surface, or its surface faces away from it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import RobustOptions
from regnf_core.robust.constants import EVIDENCE
from regnf_core.robust.residuals import DistanceModel, SurfacePair
from regnf_core.robust.samples import Samples
from regnf_core.surface.projection import newton_step


def unexplained_share(held_out: SurfacePair, T: Sim3, offset: Tensor, options: RobustOptions) -> float:
    """The share 0..1 of unexplained surface among the scene samples near the object.

    T: a single pose between the working frames · offset: of the surfaces, object diameters, a single number. A sample
    outside of the object's surface by more than twice the inlier distance is unexplained, unless it faces that surface
    and the scene shows it.
    """
    A, obj = held_out.scene_samples, held_out.obj
    s, R, t = (part.to(A.points) for part in (T.scale, T.rotation, T.translation))
    places = s * (A.points @ R.mT) + t
    value, gradient = obj.value_and_gradient(places)
    height = value - s * A.values - offset.to(value)
    near = height.abs() <= EVIDENCE.near
    if not bool(near.any()):
        return 0.0
    beyond = near & (height > EVIDENCE.beyond * options.inlier_distance)
    beneath = places[beyond] - newton_step(value[beyond], gradient[beyond], EVIDENCE.min_slope)
    slope = gradient[beyond].square().sum(-1).clamp_min(EVIDENCE.min_slope**2).sqrt()
    cosine_times_slope = ((A.normals[beyond] @ R.mT) * gradient[beyond]).sum(-1)
    unexplained = cosine_times_slope >= EVIDENCE.facing_cosine * slope
    unexplained |= _covered(held_out.scene, A, ((beneath - t) @ R) / s, options.inlier_distance / float(s))
    return float(unexplained.sum() / near.sum())


def _covered(scene: DistanceModel, A: Samples, points: Tensor, distance: float) -> Tensor:
    """(M,) bool: points (M, 3) of the scene's working frame that lie within matter, or were not observed."""
    if len(points) == 0:
        return torch.zeros(0, dtype=torch.bool)
    value, _ = scene.value_and_gradient(points)
    covered = value < -distance
    return covered if A.unobserved is None else covered | A.unobserved(points, value)
