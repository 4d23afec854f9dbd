"""Whole images that no color is fitted to, and how much the field's pictures are like them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from regnf_data.posed_images import PosedImages
from regnf_fit.images.coloring import RadianceField, SurfaceColor, appearance_of, first_hits
from regnf_fit.images.preparation import PixelRays, measured_within, rays_of_pixels

_ONE_OF = 15
_MOST_IMAGES = 4
_LEAST_IMAGES = 4
"""Of fewer images all are needed."""
_PLACES = tuple((x / 3.0, y / 3.0) for x in (-1, 0, 1) for y in (-1, 0, 1))
"""In a pixel, from its middle: a camera's pixel has the mean color of what lies in it."""
_WINDOW, _SPREAD = 11, 1.5
_LUMINANCE, _CONTRAST = 0.01**2, 0.03**2


@dataclass(frozen=True)
class Likeness:
    """psnr: decibels, over all pixels that show the thing · ssim: mean structural similarity about them, up to 1."""

    psnr: float
    ssim: float


def held_out_images(count: int) -> list[int]:
    """The numbers of the images to hold out, of so many: one of 15, evenly over them, at most four."""
    if count < _LEAST_IMAGES:
        return []
    wanted = min(max(count // _ONE_OF, 1), _MOST_IMAGES)
    return [int((i + 0.5) * count / wanted) for i in range(wanted)]


@torch.no_grad()
def likeness(
    field: RadianceField, color: SurfaceColor, images: PosedImages, chosen: list[int], size: float
) -> Likeness | None:
    """Of the field's surface, colored, to the chosen images; None where they show nothing of it."""
    squared, similar, pixels = 0.0, 0.0, 0
    for number in chosen:
        shown, seen, drawn = _picture(field, color, images, number, size)
        if not shown.any():
            continue
        pixels += int(shown.sum())
        squared += float((drawn - seen)[shown].square().mean(dim=-1).sum())
        similar += float(structural_similarity(drawn, seen)[shown].sum())
    if not pixels:
        return None
    return Likeness(-10.0 * math.log10(max(squared / pixels, 1e-10)), similar / pixels)


def structural_similarity(one: Tensor, other: Tensor) -> Tensor:
    """(H, W) of pictures (H, W, 3) in [0, 1], in Gaussian windows of 11 pixels, mean of channels (Wang et al. 2004)."""
    offsets = torch.arange(_WINDOW, dtype=one.dtype, device=one.device) - _WINDOW // 2
    bell = torch.exp(-0.5 * (offsets / _SPREAD).square())
    kernel = (bell[:, None] * bell / bell.sum().square())[None, None]

    def mean(picture: Tensor) -> Tensor:
        padded = torch.nn.functional.pad(picture.permute(2, 0, 1)[:, None], (_WINDOW // 2,) * 4, mode="replicate")
        return torch.nn.functional.conv2d(padded, kernel)[:, 0].permute(1, 2, 0)

    a, b = mean(one), mean(other)
    both = mean(one * other) - a * b
    spread = mean(one.square()) - a.square() + mean(other.square()) - b.square()
    alike = (2.0 * a * b + _LUMINANCE) * (2.0 * both + _CONTRAST)
    whole: Tensor = alike / ((a.square() + b.square() + _LUMINANCE) * (spread + _CONTRAST))
    return whole.mean(dim=-1)


def _picture(
    field: RadianceField, color: SurfaceColor, images: PosedImages, number: int, size: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Which pixels (H, W) show the thing, the image (H, W, 3), the field's picture; black where nothing is shown."""
    device = field.table.device
    height, width = images.colors.shape[1:3]
    pixels = number * height * width + np.arange(height * width)
    rays = rays_of_pixels(images, pixels, None).to(device)
    shown = ~rays.background & (rays.far > rays.near) if images.depths is None else measured_within(rays)
    index = shown.nonzero()[:, 0]
    drawn, seen = torch.zeros(len(rays), 3, device=device), torch.zeros(len(rays), 3, device=device)
    if len(index):
        behind = field.background.sigmoid()
        if bool(rays.background.any()):  # of what is behind the thing the field knows nothing
            behind = rays.colors[rays.background].mean(dim=0)
        rays = rays.take(index)
        # by what a ray's direction changes to the pixel right of its own, and to the one below it
        right, down = torch.from_numpy(images.T_world_pixel[number, :, :2].T.copy()).to(rays.directions)
        for x, y in _PLACES:
            moved = replace(rays, directions=rays.directions + x * right + y * down)
            drawn[index] += _drawn(field, color, moved, size, behind)
        drawn /= len(_PLACES)
        seen[index] = rays.colors
    return shown.view(height, width), seen.view(height, width, 3), drawn.view(height, width, 3)


def _drawn(field: RadianceField, color: SurfaceColor, rays: PixelRays, size: float, behind: Tensor) -> Tensor:
    """(R, 3): the color of the first surface that each ray meets; ``behind`` (3,) where it meets none."""
    hits = first_hits(field, rays, size)
    met = hits.depths > 0.0
    points = rays.at(torch.where(met, hits.depths, rays.far)[:, None])[:, 0]
    directions = torch.nn.functional.normalize(rays.directions, dim=1)
    return torch.where(met[:, None], color.head()(appearance_of(field, points), directions), behind)
