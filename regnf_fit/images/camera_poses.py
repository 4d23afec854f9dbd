"""Small corrections of the cameras' poses, learned with the field.

As Wang et al. (2021, "NeRF--: Neural Radiance Fields Without Known Camera Parameters") and Azinovic et al. (2022,
"Neural RGB-D Surface Reconstruction"), but held to the poses that are given by a prior of the size that the images'
own contradictions have: a correction is a rotation about the camera and a shift of it. Their mean is zero, so that the
frame is that of all the given poses: that of one image would have the errors of that image.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from regnf_core.geometry.exponential_map import rotation_exp
from regnf_data.posed_images import PosedImages
from regnf_fit.images.depth_spread import DepthSpread
from regnf_fit.images.rays import PixelRays


@dataclass(frozen=True)
class PoseErrors:
    """Standard deviations that are expected of the given poses. shift: field units · turn: radians."""

    shift: float
    turn: float


def expected_errors(spread: DepthSpread, size: float) -> PoseErrors:
    """Those that would make depths of one surface contradict each other as much as they do, each by itself.

    size: of the bounds' diagonal; where the spread is not known, a thousandth of it.
    """
    if len(spread.depths) == 0:
        return PoseErrors(1e-3 * size, 1e-3)
    shift = float(np.median(spread.deviations))
    return PoseErrors(shift, shift / float(np.median(spread.depths)))


class CameraPoses(nn.Module):
    """A correction for each of N images."""

    def __init__(self, images: int, errors: PoseErrors) -> None:
        super().__init__()
        self.steps = nn.Parameter(torch.zeros(images, 6))
        """Rotation vectors and shifts (N, 6) in world axes, in the deviations that are expected. Their mean does not
        count."""
        unit = torch.tensor([errors.turn] * 3 + [errors.shift] * 3, dtype=torch.float32)
        self.register_buffer("unit", unit)

    def corrections(self) -> tuple[Tensor, Tensor]:
        """Rotations (N, 3, 3) about the cameras and their shifts (N, 3), world axes."""
        steps = (self.steps - self.steps.mean(0)) * self.get_buffer("unit")
        return rotation_exp(steps[:, :3]), steps[:, 3:]

    def correct(self, rays: PixelRays) -> PixelRays:
        """The rays of the corrected cameras, differentiable."""
        turns, shifts = self.corrections()
        directions = (turns[rays.images] @ rays.directions[..., None]).squeeze(-1)
        return replace(rays, origins=rays.origins + shifts[rays.images], directions=directions)

    @torch.no_grad()
    def median_shift(self) -> float:
        """Of all cameras, field units."""
        return float(self.corrections()[1].norm(dim=1).median())

    def prior(self) -> Tensor:
        """Mean square of the corrections in the deviations that are expected."""
        return self.steps.square().mean()

    @torch.no_grad()
    def corrected(self, images: PosedImages) -> PosedImages:
        """The images with corrected poses."""
        turns, shifts = (part.double().cpu().numpy() for part in self.corrections())
        poses: NDArray[np.float64] = images.T_world_camera.copy()
        poses[:, :3, :3] = turns @ poses[:, :3, :3]
        poses[:, :3, 3] += shifts
        return replace(images, T_world_camera=poses)
