"""From images to what a fit draws from: rays to fit to, rays held out, and the shape to start from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from regnf_core.geometry.box import OrientedBox, ray_box_interval
from regnf_data.agreement import check_agreement
from regnf_data.posed_images import PosedImages
from regnf_fit.images.checks import check_images, check_seen
from regnf_fit.images.observing import NO_SPREAD, DepthSpread, LocalPlanes, depth_spread, local_planes
from regnf_fit.network import StartShape
from regnf_fit.options import Start

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

# Cubic cells of space, and which points lie in which.


class Cells(NamedTuple):
    """The cells that points lie in. of: (N,), each point's cell · counts: (C,), points in each."""

    of: Tensor
    counts: Tensor

    def means(self, values: Tensor) -> Tensor:
        """(C, F) float64: of the values (N, F) of each cell's points."""
        total = torch.zeros(len(self.counts), values.shape[1], dtype=torch.float64)
        return total.index_add_(0, self.of, values.double()) / self.counts[:, None]


def cells_of(points: Tensor, edge: float) -> Cells:
    """The cells of this edge that points (N, 3) lie in, N at least 1."""
    cell = (points.double() / edge).floor().long()
    cell = cell - cell.amin(0)
    across = cell.amax(0) + 1
    numbers = (cell[:, 0] * across[1] + cell[:, 1]) * across[2] + cell[:, 2]
    _, of, counts = torch.unique(numbers, return_inverse=True, return_counts=True)
    return Cells(of, counts)


# Where the surface that images show has detail: what a fit looks at more often than its share of the pixels.
#
# Floors and walls fill most pixels of a room, and the coarse levels of a grid hold them.

_BOX_MARGIN = 0.1
_EDGE = 0.02
"""Of the cells in which surface is flat or not: diagonals of the bounds."""
_UNEVEN = 0.05
"""Edges: as far from a plane, as a root mean square, is surface in a cell that is not flat."""
_LEAST = 4
"""Points in a cell, to tell."""


def in_boxes(boxes: Sequence[OrientedBox], points: Tensor) -> Tensor:
    """(N,): whether points (N, 3) lie in any of the boxes, each a little grown."""
    inside = torch.zeros(len(points), dtype=torch.bool)
    for box in boxes:
        inside |= box.contains(points, _BOX_MARGIN)
    return inside


def uneven(points: Tensor, deviations: Tensor, size: float) -> Tensor:
    """(N,): whether the points in the cell of each lie farther from a plane than their noise explains.

    points: (N, 3) of measured surface · deviations: (N,) of their noise, 0 where unknown · size: the bounds' diagonal.
    """
    if len(points) == 0:
        return torch.zeros(0, dtype=torch.bool)
    edge = _EDGE * size
    cells = cells_of(points, edge)
    off = points.double() - cells.means(points)[cells.of]
    spread = cells.means((off[:, :, None] * off[:, None, :]).flatten(1)).view(-1, 3, 3)
    noise = cells.means(deviations.double().square()[:, None])[:, 0]
    thickness = torch.linalg.eigvalsh(spread)[:, 0] - noise
    found: Tensor = ((thickness > (_UNEVEN * edge) ** 2) & (cells.counts >= _LEAST))[cells.of]
    return found


# Rays through the pixels of posed images.

Tensors = TypeVar("Tensors", bound="DataclassInstance")


def on_device(parts: Tensors, device: torch.device) -> Tensors:
    """The same with all tensors that it has on another device."""
    moved = {each.name: getattr(parts, each.name) for each in fields(parts)}
    return replace(parts, **{name: part.to(device) for name, part in moved.items() if hasattr(part, "to")})


@dataclass(frozen=True)
class PixelRays:
    """R rays, one a pixel, world frame.

    A point at depth z lies at origins + z directions: directions (R, 3) are not of unit length, their part along the
    camera's axis is 1. near, far: (R,) depths between which the ray is inside the bounds · colors: (R, 3) in [0, 1] ·
    depths: (R,), 0 where none was measured · background: (R,) true where a mask says so · cosines: (R,) between ray
    and surface normal, 0 where unknown · deviations: (R,) of the depths' noise, 0 where unknown · images: (R,) the
    number of each one's image.
    """

    origins: Tensor
    directions: Tensor
    near: Tensor
    far: Tensor
    colors: Tensor
    depths: Tensor
    background: Tensor
    cosines: Tensor
    deviations: Tensor
    images: Tensor

    def __len__(self) -> int:
        return self.origins.shape[0]

    def take(self, index: Tensor) -> PixelRays:
        """The rays at ``index`` (M,), or where a mask (R,) is true."""
        return PixelRays(*(getattr(self, name)[index] for name in self.__dataclass_fields__))

    def to(self, device: torch.device) -> PixelRays:
        return on_device(self, device)

    def at(self, depths: Tensor) -> Tensor:
        """Points (R, S, 3) at depths (R, S)."""
        return self.origins[:, None] + depths[..., None] * self.directions[:, None]


def ends_of(rays: PixelRays) -> Tensor:
    """(R, 3), where rays with depths end."""
    return rays.at(rays.depths[:, None])[:, 0]


def measured_within(rays: PixelRays) -> Tensor:
    """(R,) bool: which rays have a depth, and it ends within the bounds."""
    # near is 0 where a camera stands within the bounds, and so is a depth that was not measured
    return (rays.depths > 0.0) & (rays.depths >= rays.near) & (rays.depths <= rays.far) & ~rays.background


def rays_of_pixels(images: PosedImages, pixels: NDArray[np.int64], planes: LocalPlanes | None) -> PixelRays:
    """The rays of ``pixels`` (R,), indices into the images' (N, H, W) taken as one row.

    planes: of the images' depths.
    """
    image, row, column = np.unravel_index(pixels, images.colors.shape[:3])
    origins, directions = (torch.from_numpy(part) for part in images.rays(image, row, column))
    near, far = ray_box_interval(origins, directions, *torch.from_numpy(images.bounds))

    def picked(values: NDArray[np.generic] | None) -> Tensor:
        if values is None:
            return torch.zeros(len(pixels))
        return torch.from_numpy(values[image, row, column]).float()

    return PixelRays(
        origins=origins.float(),
        directions=directions.float(),
        near=near.float(),
        far=far.float(),
        colors=picked(images.colors) / 255.0 if len(pixels) else torch.zeros(0, 3),
        depths=picked(images.depths),
        background=picked(None if images.masks is None else ~images.masks) > 0.5,
        cosines=picked(None if planes is None else planes.cosines),
        deviations=picked(None if planes is None else planes.deviations),
        images=torch.from_numpy(image),
    )


# The shape that a field starts from: a ball of matter in free space, or a hollow ball in matter.

_START_RADIUS = 0.2
"""Diagonals: smaller than most objects, so that what is seen grows from it."""
_CELL = 0.01
"""Diagonals: surface within one such cell counts once, however often it was measured."""


def start_shape(images: PosedImages, start: Start, measured: PixelRays) -> StartShape:
    """A ball in the middle of the bounds; for a room a hollow one, so large that all of the bounds is free.

    measured: the rays that end on a surface within the bounds, none without depths. By themselves they tell a room
    from an object: its surface is seen from the side of the bounds' middle (:func:`faces_middle`). Without depths, the
    cameras tell it: most of them stand within the bounds.
    """
    low, high = images.bounds
    center, size = torch.from_numpy((low + high) / 2.0).float(), float(np.linalg.norm(high - low))
    if start == "auto" and len(measured) > 0:
        hollow = faces_middle(measured, center, size)
    else:
        cameras = images.T_world_camera[:, :3, 3]
        within = float(((cameras > low) & (cameras < high)).all(axis=1).mean())
        hollow = start == "room" or (start == "auto" and within > 0.5)
    return StartShape(center, (0.5 if hollow else _START_RADIUS) * size, hollow)


def faces_middle(measured: PixelRays, center: Tensor, size: float) -> bool:
    """Whether surface that was measured, at least one ray, is rather seen from the side of ``center`` (3,).

    It is the sign of the sum, over equal cells of surface, of (mean direction to the cameras) . (place - center): a
    convex object seen from outside has a positive sum, a room seen from inside a negative one. size: the bounds'
    diagonal, field units.
    """
    ends = ends_of(measured)
    cells = cells_of(ends, _CELL * size)
    towards_camera = cells.means(-torch.nn.functional.normalize(measured.directions, dim=1))
    return bool((towards_camera * (cells.means(ends) - center)).sum() < 0.0)


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
