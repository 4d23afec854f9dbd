"""From images to what a fit draws from: rays to fit to, rays held out, and the shape to start from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from regnf_core.geometry.box import OrientedBox
from regnf_data.posed_images import PosedImages
from regnf_fit.images.agreement import check_agreement
from regnf_fit.images.checks import check_images, check_seen
from regnf_fit.images.depth_normals import local_planes
from regnf_fit.images.depth_spread import NO_SPREAD, DepthSpread, depth_spread
from regnf_fit.images.options import Start
from regnf_fit.images.rays import PixelRays, measured_within, rays_of_pixels
from regnf_fit.images.starting import start_shape
from regnf_fit.network import StartShape

_MAX_PIXELS = 3_000_000
_HELD_OUT_SHARE = 0.02
_MAX_HELD_OUT = 4_000


@dataclass(frozen=True)
class PreparedImages:
    """training, held_out: rays of different pixels · held_out_pixels: indices of the latter into the images' (N, H, W)
    taken as one row · size: diagonal of the bounds (2, 3), field units · boxes: of the
    instances that the dataset names · pixel: a pixel's width at depth 1 · spread: of depths, from image to image ·
    images: how many · warnings: of images that contradict each other."""

    training: PixelRays
    held_out: PixelRays
    held_out_pixels: NDArray[np.int64]
    start: StartShape
    bounds: torch.Tensor
    size: float
    has_depth: bool
    boxes: tuple[OrientedBox, ...]
    pixel: float
    spread: DepthSpread
    images: int
    warnings: tuple[str, ...]


def prepare(
    images: PosedImages, start: Start, rng: np.random.Generator, given: PosedImages | None = None
) -> PreparedImages:
    """The rays that meet the bounds, at most three million. given: the images in their own world, which refusals tell
    of, where they were moved from it. Raises DatasetError, see :func:`check_images`."""
    given = given or images
    check_images(given)
    warning = check_agreement(given)
    pixels = rng.permutation(images.colors[..., 0].size)[:_MAX_PIXELS]
    planes = None if images.depths is None else local_planes(images.depths, images.intrinsics)
    rays = rays_of_pixels(images, pixels, planes)
    meet = rays.far > rays.near
    rays, pixels = rays.take(meet), pixels[meet.numpy()]
    has_depth = images.depths is not None
    shown = measured_within(rays) if has_depth else ~rays.background
    check_seen(given, int(shown.sum()))
    held_out = min(int(_HELD_OUT_SHARE * len(rays)), _MAX_HELD_OUT)
    order = torch.arange(len(rays))
    return PreparedImages(
        training=rays.take(order[held_out:]),
        held_out=rays.take(order[:held_out]),
        held_out_pixels=pixels[:held_out],
        start=start_shape(images, start, rays.take(measured_within(rays))),
        bounds=torch.from_numpy(images.bounds),
        size=float(np.linalg.norm(images.bounds[1] - images.bounds[0])),
        has_depth=has_depth,
        boxes=tuple(instance.box for instance in images.instances),
        pixel=float(1.0 / np.median(images.intrinsics[:, 0, 0])),
        spread=NO_SPREAD if planes is None else depth_spread(images, planes.cosines),
        images=len(images),
        warnings=() if warning is None else (warning,),
    )
