"""What posed depth images have seen of a volume."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from itertools import product
from math import sqrt
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.numpy import load_file
from torch import Tensor
from torch.nn.functional import max_pool2d

from regnf_core.errors import DatasetError, InvalidOptionsError
from regnf_core.fields.build import open_field
from regnf_core.fields.observation import Observation, SdfField
from regnf_core.schema.description import FREE, MAX_COUNT, OBSERVATION, SURFACE, UNSEEN
from regnf_core.schema.safe_format import read_description, write_safe_field
from regnf_data.posed_images import PosedImages

# How far depths of one surface lie apart from image to image: the sensor's noise and the poses' errors together.
#
# A plane through neighboring pixels shows the noise that differs from pixel to pixel. What the pixels of one image
# share shows only beside other images: errors of its pose, and of a sensor's calibration.

Floats = NDArray[np.float64]

_PAIRS, _SPREAD_PIXELS = 600, 500
"""Pairs of images that are drawn, and pixels of the first that are looked up in the second."""
_SAME_SURFACE = 0.04
"""Depths that differ by a larger share lie on different surfaces: on one seen at 60 degrees a pixel of a common camera
makes a hundredth."""
_BINS, _LEAST_IN_BIN = 8, 200
_MAD_TO_DEVIATION = 1.4826
_REACH = 3.0
"""Deviations that count as the same surface, once the deviation is known."""
_ROUNDS = 20


@dataclass(frozen=True)
class DepthSpread:
    """The standard deviation (K,) across a surface, world units, of depths about (K,) ascending; none where K = 0."""

    depths: Floats
    deviations: Floats

    def at(self, depths: NDArray[np.float32]) -> NDArray[np.float32]:
        """The deviation at each of the depths (R,), 0 where nothing is known."""
        if len(self.depths) == 0:
            return np.zeros_like(depths)
        return np.interp(depths, self.depths, self.deviations).astype(np.float32)

    def median(self, depths: NDArray[np.float32]) -> float:
        """The deviation in the median over the depths (R,), at least one."""
        return float(np.median(self.at(depths)))


NO_SPREAD = DepthSpread(np.zeros(0), np.zeros(0))
"""Nothing is known."""


def depth_spread(images: PosedImages, cosines: NDArray[np.float32]) -> DepthSpread:
    """From pixels of one image that are seen in another too. Deterministic.

    cosines: (N, H, W) between ray and surface normal, 0 where unknown: such pixels are left out. Without overlapping
    images, or without depths, nothing is known.
    """
    if images.depths is None or len(images) < 2:
        return NO_SPREAD
    rng = np.random.default_rng(0)
    pairs = rng.integers(len(images), size=(_PAIRS, 2))
    found = [_differences(images, cosines, first, second, rng) for first, second in pairs if first != second]
    depths, apart = (np.concatenate(parts) for parts in zip(*found, strict=True))
    count = min(_BINS, len(depths) // _LEAST_IN_BIN)
    if count == 0:
        return NO_SPREAD
    bins = np.array_split(np.argsort(depths), count)
    # the difference of two images' depths has sqrt(2) times the deviation of one's
    deviations = [_deviation(apart[part]) / sqrt(2.0) for part in bins]
    return DepthSpread(np.array([np.median(depths[part]) for part in bins]), np.array(deviations))


def _differences(
    images: PosedImages, cosines: NDArray[np.float32], first: int, second: int, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Depths (M,) in the second image where pixels of the first fall, each the mean of both, and how far the first's
    lie before or behind, across the surface; those too far off to be of the same surface are left out."""
    assert images.depths is not None
    height, width = images.size
    pixels = rng.integers(height * width, size=_SPREAD_PIXELS)
    depth = images.depths[first].reshape(-1)[pixels].astype(np.float64)
    row, column = np.divmod(pixels, width)
    pixels = np.stack([column + 0.5, row + 0.5, np.ones(_SPREAD_PIXELS)], axis=-1)
    rays = pixels @ np.linalg.inv(images.intrinsics[first]).T
    T = np.linalg.inv(images.T_world_camera[second]) @ images.T_world_camera[first]
    seen = (rays * depth[:, None])[depth > 0.0] @ T[:3, :3].T + T[:3, 3]
    seen = seen[seen[:, 2] > 0.0]
    places = seen @ images.intrinsics[second].T
    column, row = np.floor(places[:, :2] / places[:, 2:]).astype(np.int64).T
    shown = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    seen, column, row = seen[shown], column[shown], row[shown]
    measured = images.depths[second][row, column].astype(np.float64)
    cosine = cosines[second][row, column].astype(np.float64)
    length = np.linalg.norm(seen, axis=1) / seen[:, 2]  # of the ray, a unit of depth
    same = (cosine > 0.0) & (measured > 0.0) & (np.abs(seen[:, 2] - measured) < _SAME_SURFACE * measured)
    apart = (seen[:, 2] - measured) * length * cosine
    # the mean does not depend on the difference, as either depth does: bins of it have the differences of all
    return ((seen[:, 2] + measured) / 2.0)[same], apart[same]


def _deviation(values: Floats) -> float:
    """The standard deviation of most of the values, whatever the others are."""
    size = np.abs(values)
    reach = float(size.max())
    for _ in range(_ROUNDS):
        reach = min(reach, _REACH * _MAD_TO_DEVIATION * float(np.median(size[size <= reach])))
    return reach / _REACH


# How steeply each pixel's ray meets the surface, and how noisy its depth is, from the depths around it.

_NORMAL_REACH = 2
"""Pixels on either side: a window of 5 x 5 is wide enough to average a sensor's noise."""
_MIN_PIXELS = 8
_STEEPEST_NORMAL = 0.1
_DEPTH_BINS = 20


@dataclass(frozen=True)
class LocalPlanes:
    """Of N images: cosines (N, H, W) between ray and surface normal, at least 0.1, 0 where no plane could be laid ·
    deviations: (N, H, W) standard deviation of a depth's noise, its own units."""

    cosines: NDArray[np.float32]
    deviations: NDArray[np.float32]


def local_planes(depths: NDArray[np.float32], intrinsics: Floats) -> LocalPlanes:
    """A plane for every pixel.

    depths: (N, H, W) · intrinsics: (N, 3, 3). On a plane 1/z is linear in the pixel's place, and the plane's normal
    follows from the slopes; they are fitted by least squares over a window, to depths close to the pixel's own: a thin
    leg keeps its own plane before the wall behind it. The noise at a depth is the median of what the planes at about
    that depth leave over.
    """
    cosines, left_over = np.zeros(depths.shape, np.float32), np.zeros(depths.shape, np.float32)
    for image, (depth, camera) in enumerate(zip(depths, intrinsics, strict=True)):
        planes = pixel_planes(depth, camera)
        cosines[image], left_over[image] = planes.cosines, planes.deviations
    known = cosines > 0.0
    if not known.any():
        return LocalPlanes(cosines, np.zeros_like(depths))
    z, noise = depths[known], left_over[known]
    edges = np.quantile(z, np.linspace(0.0, 1.0, _DEPTH_BINS + 1))
    bins = np.clip(np.searchsorted(edges, z, side="right") - 1, 0, _DEPTH_BINS - 1)
    filled = [i for i in range(_DEPTH_BINS) if (bins == i).any()]
    middles = [float(np.median(z[bins == i])) for i in filled]
    medians = [float(np.median(noise[bins == i])) for i in filled]
    return LocalPlanes(cosines, np.interp(depths, middles, medians).astype(np.float32))


@dataclass(frozen=True, eq=False)
class PixelPlanes:
    """Of one image. known: (H, W), where a plane could be laid; elsewhere the others mean nothing · normals: (H, W, 3),
    unit, camera frame, towards the camera · cosines, deviations: (H, W), see LocalPlanes."""

    known: NDArray[np.bool_]
    normals: NDArray[np.float32]
    cosines: NDArray[np.float32]
    deviations: NDArray[np.float32]


_ROWS = 24
"""That are done at once: what is in use stays in the processor's cache."""


def pixel_planes(depth: NDArray[np.float32], camera: Floats) -> PixelPlanes:
    """The planes of :func:`local_planes` for one image. depth: (H, W) · camera: (3, 3)."""
    K_inverse = np.asarray(np.linalg.inv(camera))
    inverses = np.divide(1.0, depth, out=np.zeros_like(depth, np.float64), where=depth > 0.0)
    around = np.pad(np.where(depth > 0.0, inverses, np.inf), _NORMAL_REACH, constant_values=np.inf)
    parts = []
    for top in range(0, len(depth), _ROWS):
        inverse, measured = inverses[top : top + _ROWS], depth[top : top + _ROWS].astype(np.float64)
        rows, columns = np.indices(inverse.shape) + 0.5
        rays = np.stack([columns, rows + top, np.ones_like(rows)], axis=-1) @ K_inverse.T
        x, y, z = np.ascontiguousarray(np.moveaxis(rays, 2, 0))  # of the rays, (h, W) each
        count, sums = _moments(K_inverse[:2, :2], inverse, around[top : top + len(inverse) + 2 * _NORMAL_REACH])
        known = (measured > 0.0) & (count >= _MIN_PIXELS)
        mx, my, mi, xx, yy, xy, xi, yi, ii = sums / np.where(known, count, 1.0)
        # all relative to the pixel itself, see _moments
        xx, yy, xy = xx - mx * mx, yy - my * my, xy - mx * my
        xi, yi, ii = xi - mx * mi, yi - my * mi, ii - mi * mi
        determinant = xx * yy - xy * xy
        known &= determinant > 1e-2 * (xx + yy) ** 2
        determinant = np.where(known, determinant, 1.0)
        a, b = (yy * xi - xy * yi) / determinant, (xx * yi - xy * xi) / determinant
        # 1/z = a x + b y + c: the plane's normal is (a, b, c), and its product with the ray (x, y, 1) is 1/z
        here = inverse + mi - a * mx - b * my
        c = here - a * x - b * y
        length = np.sqrt(a * a + b * b + c * c)
        cosine = here / np.maximum(length * np.sqrt(x * x + y * y + z * z), 1e-12)
        # three numbers were fitted to each window; a deviation of 1/z is one of z by z squared
        variance = np.maximum(ii - a * xi - b * yi, 0.0) * count / np.maximum(count - 3.0, 1.0)
        deviation = np.where(known, np.sqrt(variance) * measured**2, 0.0)
        cosine = np.where(known, np.clip(cosine, _STEEPEST_NORMAL, 1.0), 0.0)
        normals = np.stack([a, b, c], axis=-1) / -np.maximum(length, 1e-12)[..., None]
        parts.append((known, *(each.astype(np.float32) for each in (normals, cosine, deviation))))
    return PixelPlanes(*map(np.concatenate, zip(*parts, strict=True)))


def _moments(step: Floats, inverse: Floats, around: Floats) -> tuple[Floats, Floats]:
    """How many pixels of each window lie on its middle's surface, (H, W), and sums over them, (9, H, W): of x, y and
    i = 1/z less the middle's, and of their products xx, yy, xy, xi, yi, ii.

    step: (2, 2), x and y of one pixel to the right and of one down: those of a window's pixels are the same everywhere
    · around: as ``inverse``, and what windows reach on every side, infinite where there is no depth.
    """
    height, width = inverse.shape
    offsets = list(product(range(2 * _NORMAL_REACH + 1), repeat=2))
    x, y = step @ (np.array(offsets).T[::-1] - _NORMAL_REACH)
    of_count, of_inverse = np.stack([np.ones_like(x), x, y, x * x, y * y, x * y]), np.stack([np.ones_like(x), x, y])
    i = np.stack([around[down : down + height, right : right + width] for down, right in offsets]) - inverse
    same = np.abs(i) < _SAME_SURFACE * inverse
    i[~same] = 0.0
    flat = i.reshape(len(offsets), -1)
    counted = (of_count @ same.reshape(len(offsets), -1).astype(np.float64)).reshape(6, height, width)
    sums = np.empty((9, height, width))
    sums[0:2], sums[3:6] = counted[1:3], counted[3:]
    sums[2], sums[6], sums[7] = (of_inverse @ flat).reshape(3, height, width)
    sums[8] = np.einsum("kn,kn->n", flat, flat).reshape(height, width)
    return counted[0], sums


_MARGIN = 1.0
"""Voxels before a measured surface that may be matter as well."""
_SPREADS = 3.0
"""The same in standard deviations of a depth, where the images contradict each other by more."""
_PIXELS = 1.2
"""Widths of a pixel that a voxel is across at least: narrower ones would fall between the pixels' rays."""
_AT_ONCE = 1 << 17
"""Voxels that are looked up in an image at once: what is in use stays in the processor's cache."""
_CHECKED, _NEAR, _AGREEING = 2000, 2.0, 0.6
"""So many voxels with surface are looked up in a field; this share of them must be within so many voxels of its own, or
within ``_SPREADS`` deviations of the depths."""


def observe(images: PosedImages, voxels: int, spread: DepthSpread = NO_SPREAD) -> Observation | None:
    """Carve the bounds (Kutulakos and Seitz 2000, "A Theory of Shape by Space Carving", with depths for colors): what
    a camera looked through is free, where a depth ends there is a surface, the rest is unobserved.

    voxels: along the longest side of the bounds; fewer where a pixel is wider than that. None without depths, or for 0.
    spread: of the depths from image to image; what is nearer to a measured surface than that is not seen to be free.
    A voxel is free where all four rays around its center, in some image, pass it by: at the edge of an object one of
    them ends there. (The center's own pixel is not enough: voxels are about as wide as a pixel.)

    Raises InvalidOptionsError for more voxels than a regnf field file keeps.
    """
    if not 0 <= voxels <= MAX_COUNT:
        raise InvalidOptionsError(f"observation_voxels: {voxels} is not from 0 to {MAX_COUNT}")
    if images.depths is None or voxels == 0:
        return None
    low, high = torch.from_numpy(images.bounds)
    widths = (images.depths / images.intrinsics[:, 0, 0, None, None])[images.depths > 0.0]  # of pixels where depths end
    voxel = max(float((high - low).max()) / voxels, _PIXELS * float(np.median(widths)) if widths.size else 0.0)
    counts = [int(n) for n in ((high - low) / voxel - 1e-9).ceil().clamp_min(1)]
    states = torch.full(counts, UNSEEN, dtype=torch.uint8).view(-1)
    axes = [low[k] + (torch.arange(counts[k], dtype=torch.float64) + 0.5) * voxel for k in range(3)]
    centers = torch.cartesian_prod(*axes).float()
    left = list(torch.split(torch.arange(len(centers)), _AT_ONCE))
    for image in range(len(images)):
        margins = np.maximum(_SPREADS * spread.at(images.depths[image]), np.float32(_MARGIN * voxel))
        clear = _clear_depths(images, image, margins)
        for number, part in enumerate(left):
            free = _looked_through(centers[part], images, image, clear)
            states[part[free]] = FREE
            left[number] = part[~free]
    measured = images.measured
    ends = torch.from_numpy(np.concatenate([images.ends(image)[measured[image]] for image in range(len(images))]))
    cells = ((ends - low) / voxel).floor().long()
    x, y, z = cells[((cells >= 0) & (cells < torch.tensor(counts))).all(-1)].unbind(-1)
    states.view(counts)[x, y, z] = SURFACE
    return Observation(states.view(counts), low, voxel)


def _clear_depths(images: PosedImages, image: int, margins: NDArray[np.float32]) -> Tensor:
    """(H + 1, W + 1): up to which depth all pixels at each corner of pixels were seen to be free; 0 where one of them
    shows nothing.

    margins: (H, W) before what was measured, along the camera's axis. The background is infinitely far.
    """
    assert images.depths is not None
    measured = images.depths[image]
    clear = np.where(measured > 0.0, measured - margins, np.float32(0.0))
    if images.masks is not None:
        clear = np.where(images.masks[image], clear, np.float32(np.inf))
    return -max_pool2d(torch.from_numpy(-clear)[None], kernel_size=2, stride=1, padding=1)[0]


def _looked_through(centers: Tensor, images: PosedImages, image: int, clear: Tensor) -> Tensor:
    """(N,) bool: which voxels with centers (N, 3) one image looked through. clear: of its pixels' corners, see
    ``_clear_depths``."""
    T_camera_world = np.linalg.inv(images.T_world_camera[image])
    projection = torch.from_numpy(images.intrinsics[image] @ T_camera_world[:3]).float()
    x, y, z = torch.addmm(projection[:, 3:], projection[:, :3], centers.T)
    depth = z.clamp_min(1e-6)
    column, row = x.div_(depth), y.div_(depth)
    height, width = images.size
    shown = (z > 1e-6) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    at = shown.nonzero()[:, 0]
    corner = (row[at] + 0.5).long(), (column[at] + 0.5).long()
    free = z[at] < clear[corner]
    return torch.zeros_like(shown).index_put((at,), free)


def attach_observation(
    path: Path, images: PosedImages, voxels: int = 192, spread: DepthSpread | None = None
) -> Observation:
    """Keep with the regnf field file in ``path`` what ``images`` of the same scene, in the field's frame, have seen.

    spread: of the depths from image to image; None: as these images show it, all of whose pixels it takes.
    Raises DatasetError: DATASET_DEPTH_MISSING, or DATASET_OF_ANOTHER_FRAME where the field has no surface where the
    images saw one; FieldFormatError as :func:`regnf_core.fields.build.open_field`.
    """
    if spread is None and images.depths is not None:
        spread = depth_spread(images, local_planes(images.depths, images.intrinsics).cosines)
    spread = spread or NO_SPREAD
    seen = observe(images, voxels, spread)
    if seen is None or images.depths is None:
        raise DatasetError("an observation needs depths, and there are none", reason="DATASET_DEPTH_MISSING")
    measured = images.depths[images.depths > 0.0]
    _check_frame(open_field(path), seen, _SPREADS * spread.median(measured) if len(measured) else 0.0)
    description = read_description(path)
    scale = float(description["world_scale"])
    grid, words = replace(seen, low=seen.low / scale, voxel=seen.voxel / scale).stored()
    tensors = {**load_file(path), OBSERVATION: words}
    write_safe_field(path, {**description, OBSERVATION: asdict(grid)}, tensors)
    return seen


def _check_frame(field: SdfField, seen: Observation, noise: float) -> None:
    """Raise DatasetError (DATASET_OF_ANOTHER_FRAME) unless the field's surface runs where one was measured.

    noise: how far from it depths may end, world units; many voxels in a small object before a coarse sensor.
    """
    cells = (seen.states == SURFACE).nonzero()
    cells = cells[:: max(1, len(cells) // _CHECKED)]
    points = ((cells + 0.5) * seen.voxel + seen.low).float()
    distance = field.signed_distance(points.to(field.device)).abs().cpu()
    near = max(_NEAR * seen.voxel, noise)
    if len(cells) == 0 or not float((distance <= near).float().mean()) >= _AGREEING:
        raise DatasetError(
            "the field has no surface where the images show one. Check that both are of the same scene, in the same "
            "frame.",
            reason="DATASET_OF_ANOTHER_FRAME",
        )
