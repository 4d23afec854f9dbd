"""Surface of the scene that is joined to the object and is no part of it: a cushion on a chair that should have none.

Things that stand close by have surface near the object as well, but what they turn towards it faces the object's own,
which is there too. What lies on the object hides its surface, or turns its sides and its back to it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import RobustOptions
from regnf_core.robust.residuals import DistanceModel, Samples
from regnf_core.robust.verdict.evidence import REACH
from regnf_core.surface.projection import newton_step

_BEYOND = 2.0  # inlier distances: farther from the object's surface a sample is no part of it
_MIN_SLOPE = 1e-3  # a gradient shorter than this has no direction
_FACING = -0.25  # cosines of the normals beneath this: surface that faces the object's


def extra_share(
    scene: DistanceModel, obj: DistanceModel, A: Samples, T: Sim3, offset: Tensor, options: RobustOptions
) -> float:
    """The share 0..1, of the scene samples A near the object, of those on extra surface.

    T: a single pose between the working frames · offset: of the surfaces, object diameters, a single number. Samples
    farther from the object's surface than twice the inlier distance are extra, unless they face it and it is there.
    """
    s, R, t = (part.to(A.points) for part in (T.scale, T.rotation, T.translation))
    places = s * (A.points @ R.mT) + t
    value, gradient = obj.value_and_gradient(places)
    height = value - s * A.values - offset.to(value)
    near = height.abs() <= REACH
    if not bool(near.any()):
        return 0.0
    beyond = near & (height > _BEYOND * options.inlier_distance)
    beneath = places[beyond] - newton_step(value[beyond], gradient[beyond], _MIN_SLOPE)
    slope = gradient[beyond].square().sum(-1).clamp_min(_MIN_SLOPE**2).sqrt()
    extra = ((A.normals[beyond] @ R.mT) * gradient[beyond]).sum(-1) >= _FACING * slope
    extra |= _covered(scene, A, ((beneath - t) @ R) / s, options.inlier_distance / float(s))
    return float(extra.sum() / near.sum())


def _covered(scene: DistanceModel, A: Samples, points: Tensor, distance: float) -> Tensor:
    """(M,) bool: points (M, 3) of the scene's working frame within matter, or where nobody looked."""
    if len(points) == 0:
        return torch.zeros(0, dtype=torch.bool)
    value, _ = scene.value_and_gradient(points)
    covered = value < -distance
    return covered if A.unseen is None else covered | A.unseen(points, value)
