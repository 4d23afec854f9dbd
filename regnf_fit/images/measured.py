"""The surface that depth images measured, and how wide their pixels are at it."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from regnf_fit.images.preparation import PreparedImages
from regnf_fit.images.rays import PixelRays, measured_within

_SHARP = 0.25
"""The share of the pixels that are no wider at their surface than :func:`sharp_width`."""


def measured_rays(prepared: PreparedImages) -> PixelRays:
    """The training rays whose depth lies within the bounds."""
    return prepared.training.take(measured_within(prepared.training))


def ends_of(rays: PixelRays) -> Tensor:
    """(R, 3), where rays with depths end."""
    return rays.at(rays.depths[:, None])[:, 0]


def sharp_width(prepared: PreparedImages, rays: PixelRays) -> float:
    """The width of a pixel of the sharper images at its surface, field units; of at least one ray."""
    return prepared.pixel * float(np.quantile(rays.depths.numpy(), _SHARP))
