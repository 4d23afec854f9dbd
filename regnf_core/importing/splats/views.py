"""From where Gaussian splats are looked at, when no camera came with them; and depths that other views contradict."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.spatial import cKDTree

from regnf_core.importing.meshes.cloud_normals import directions, oriented
from regnf_core.importing.splats.drawing import MOST_PIXELS, Camera, Prepared, depth_image
from regnf_core.importing.splats.gaussians import Doubles, Floats, Splats

_SAMPLE, _CLEAR = 10_000, 0.3
"""Splats that the extent is told from, of those with so much opacity."""
_NEIGHBOR, _ALONE = 8, 5.0
"""A splat whose distance to this neighbor is so many times the usual one lies alone: a floater, or the background."""
_MARGIN = 0.03
"""The box around the others, longer by this share of its diagonal on every side."""
_ROUND, _AWAY = 40, 2.2
"""Views of an object, and how many radii of its box the cameras are from its middle."""
_SIDE_ROUND, _SIDE_WITHIN = 256, 192
"""Pixels along an image's side."""
_PLACES, _CELLS = 12, 48
"""Places within a scene, six views each; cells along the longest edge, in which they are looked for."""
_FULL = 0.5
"""A cell is matter where the splats in it stop so much light."""
_ENCLOSED = 0.8
"""Places from which at least this share of what the most enclosed place has is matter, of the directions of view."""
_MOST_GIVEN = 96
"""Cameras that are used, of those given."""
_OTHERS = 24
"""The nearest views, with which each depth is compared."""
_LAYER = 1.5
"""Voxels: how far from where half of the light is stopped splats are of the same layer, a standard deviation."""
_TOUCHING, _APART = 6, 4.0
"""A splat touches its surface if it has so many neighbors within so many of its own longest standard deviations."""
_AGREE = 0.02
"""Depths agree within this share of themselves ..."""
_AGREE_VOXELS = 3.0
"""... or this many voxels."""
_LEAST_AGREEING = 2


class Trained(Protocol):
    """The cameras of a training, as of :class:`regnf_core.importing.observing.trajectory.Trajectory`."""

    @property
    def poses(self) -> Doubles: ...
    @property
    def focal(self) -> Doubles: ...
    @property
    def middle(self) -> Doubles: ...
    @property
    def aspect(self) -> Doubles: ...
    @property
    def T_dataset_file(self) -> Doubles | None: ...
    def __len__(self) -> int: ...


@dataclass(frozen=True, eq=False)
class Region:
    """low, high: (3,), of the box that is fused · within: whether it is a room, looked at from inside."""

    low: Doubles
    high: Doubles
    within: bool

    @property
    def longest(self) -> float:
        return float((self.high - self.low).max())


def region_of(splats: Splats, bounds: Doubles | None, within: bool | None) -> Region:
    """Where most of the matter is. bounds: (2, 3), where it is known; within: where that is known."""
    clear = np.flatnonzero(splats.opacities >= _CLEAR)
    clear = clear if len(clear) > _NEIGHBOR else np.arange(len(splats))
    if bounds is not None:
        clear = clear[((splats.means[clear] >= bounds[0]) & (splats.means[clear] <= bounds[1])).all(axis=1)]
    clear = np.random.default_rng(0).permutation(clear)[:_SAMPLE]
    points = splats.means[clear]
    if len(points) > _NEIGHBOR:
        apart = cKDTree(points).query(points, k=_NEIGHBOR + 1)[0][:, -1]
        points = points[apart <= _ALONE * np.median(apart)]
    if bounds is None:
        low, high = (points.min(axis=0), points.max(axis=0)) if len(points) else (np.zeros(3), np.ones(3))
        margin = _MARGIN * max(float(np.linalg.norm(high - low)), 1e-9)
        bounds = np.stack([low - margin, high + margin])
    if within is None:
        extent = float(np.linalg.norm(np.ptp(points, axis=0))) if len(points) > _NEIGHBOR else 0.0
        within = extent > 0.0 and oriented((points - points.min(axis=0)) / extent, None, None, None).within
    return Region(bounds[0], bounds[1], bool(within))


def touching(splats: Splats) -> npt.NDArray[np.bool_]:
    """(N,): False for floaters, which lie apart from all others by their own size."""
    if len(splats) <= _TOUCHING:
        return np.ones(len(splats), np.bool_)
    apart = cKDTree(splats.means).query(splats.means, k=_TOUCHING + 1, workers=-1)[0][:, -1]
    kept: npt.NDArray[np.bool_] = apart <= _APART * np.exp(splats.scales.max(axis=1))
    return kept if kept.mean() >= 0.5 else np.ones(len(splats), np.bool_)


def cameras_for(splats: Splats, region: Region) -> list[Camera]:
    """Views from around an object, or from places within a scene to all sides."""
    return _within(splats, region) if region.within else _around(region)


def given_cameras(
    trajectory: Trained, T_file_splats: Doubles, most: int = _MOST_GIVEN, pixels: int = MOST_PIXELS
) -> list[Camera]:
    """Of the cameras from whose images the splats were trained, some, spread over the trajectory.

    T_file_splats: (4, 4), a similarity from the frame of the splats to that of the cameras' poses · most: of the
    cameras · pixels: of an image, at most.
    """
    scale = float(np.cbrt(np.linalg.det(T_file_splats[:3, :3])))
    chosen = np.unique(np.linspace(0, len(trajectory) - 1, min(most, len(trajectory))).round().astype(int))
    found = []
    for number in chosen:
        aspect = float(trajectory.aspect[number])
        height = int(min(_SIDE_ROUND, np.sqrt(pixels / aspect)))
        size = np.array([max(1, int(height * aspect)), height])
        focal, middle = trajectory.focal[number] * size, trajectory.middle[number] * size
        T_camera_splats = np.linalg.inv(trajectory.poses[number]) @ T_file_splats
        T_camera_splats[:3] /= scale
        found.append(
            Camera(
                T_camera_splats,
                (float(focal[0]), float(focal[1])),
                (float(middle[0]), float(middle[1])),
                (int(size[0]), int(size[1])),
            )
        )
    return found


def _around(region: Region) -> list[Camera]:
    middle, radius = (region.low + region.high) / 2, float(np.linalg.norm(region.high - region.low)) / 2
    corners = np.array([np.where(which, region.high, region.low) for which in np.ndindex(2, 2, 2)])
    found = []
    for one in directions(_ROUND):
        T = _looking(middle + _AWAY * radius * one, -one)
        local = corners @ T[:3, :3].T + T[:3, 3]
        rays = local[:, :2] / local[:, 2:]
        low, high = rays.min(axis=0), rays.max(axis=0)
        focal = _SIDE_ROUND / float((high - low).max())
        x, y = _SIDE_ROUND / 2 - focal * (low + high) / 2
        found.append(Camera(T, (focal, focal), (float(x), float(y)), (_SIDE_ROUND, _SIDE_ROUND)))
    return found


def _looking(place: Doubles, forward: Doubles) -> Doubles:
    """(4, 4), from the world to a camera at a place that looks along a unit vector."""
    side = np.eye(3)[int(np.abs(forward).argmin())]
    right = np.cross(forward, side)
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    T[:3, 3] = -T[:3, :3] @ place
    return T


def _within(splats: Splats, region: Region) -> list[Camera]:
    half = _SIDE_WITHIN / 2
    sides = [sign * axis for axis in np.eye(3) for sign in (1.0, -1.0)]
    return [
        Camera(_looking(place, side), (half, half), (half, half), (_SIDE_WITHIN, _SIDE_WITHIN))
        for place in _free_places(splats, region)
        for side in sides
    ]


def _free_places(splats: Splats, region: Region) -> Doubles:
    """(P, 3): places in cells without matter that are enclosed by it, far from it and from each other."""
    cell = region.longest / _CELLS
    shape = np.maximum(np.ceil((region.high - region.low) / cell), 1).astype(int)
    index = np.floor((splats.means - region.low) / cell).astype(int)
    kept = ((index >= 0) & (index < shape)).all(axis=1)
    stopped = np.zeros(shape)
    area = np.exp(2.0 * np.sort(splats.scales[kept].astype(np.float64), axis=1)[:, 1:].mean(axis=1))
    share = splats.opacities[kept] * np.minimum(2.0 * np.pi * area / cell**2, 1.0)
    np.add.at(stopped, tuple(index[kept].T), share)
    matter = 1.0 - np.exp(-stopped) > _FULL
    free = ~matter
    enclosed = _share_enclosed(matter)
    good = free & (enclosed >= _ENCLOSED * enclosed[free].max(initial=0.0))
    room = ndimage.distance_transform_edt(np.pad(free, 1, constant_values=True))[1:-1, 1:-1, 1:-1]
    cells = np.argwhere(good)
    far = np.minimum(room[good], 0.25 * min(shape))  # farther from matter is not better
    chosen: list[int] = []
    apart = np.full(len(cells), np.inf)
    while len(chosen) < min(_PLACES, len(cells)):
        worth = np.minimum(2.0 * far, apart)
        chosen.append(int(worth.argmax()))
        apart = np.minimum(apart, np.linalg.norm(cells - cells[chosen[-1]], axis=1))
        if apart.max() < 1.0:
            break
    return region.low + cell * (cells[chosen] + 0.5)


def _share_enclosed(matter: npt.NDArray[np.bool_]) -> Doubles:
    """Of the 26 directions to a cell's neighbors, the share in which matter lies, however far."""
    steps = [step for step in np.ndindex(3, 3, 3) if step != (1, 1, 1)]
    total = np.zeros(matter.shape)
    for step in steps:
        ray, behind = matter.copy(), matter
        shift = np.array(step) - 1
        for _ in range(max(matter.shape)):
            behind = _moved(behind, shift)
            if not behind.any():
                break
            ray |= behind
        total += ray
    return total / len(steps)


def _moved(cells: npt.NDArray[np.bool_], shift: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    moved = np.zeros_like(cells)
    into = tuple(slice(max(s, 0), n + min(s, 0)) for s, n in zip(shift, cells.shape, strict=True))
    out = tuple(slice(max(-s, 0), n + min(-s, 0)) for s, n in zip(shift, cells.shape, strict=True))
    moved[into] = cells[out]
    return moved


@dataclass(frozen=True, eq=False)
class Seen:
    """What a camera sees: depths (H, W), 0 where it does not tell, and colors (H, W, 3), if they are known."""

    camera: Camera
    depth: Floats
    color: npt.NDArray[np.uint8] | None

    def ends(self) -> Doubles:
        """(H, W, 3): where the depths end, in the world; the camera's place where there is none."""
        row, column = np.indices(self.depth.shape) + 0.5
        pixels = np.stack([column, row, np.ones_like(row)], axis=-1)
        local = self.depth[..., None] * (pixels @ np.linalg.inv(self.camera.matrix).T)
        T = np.linalg.inv(self.camera.T_camera_world)
        ends: Doubles = local @ T[:3, :3].T + T[:3, 3]
        return ends

    def depth_at(self, points: Doubles) -> tuple[Doubles, Doubles]:
        """(M,): the depths in the directions of points (M, 3), 0 where there is none, NaN beside the image; and the
        points' own."""
        T = self.camera.T_camera_world
        local = points @ T[:3, :3].T + T[:3, 3]
        own = local[:, 2]
        with np.errstate(all="ignore"):
            pixel = local[:, :2] / own[:, None] * self.camera.focal + self.camera.middle
        height, width = self.depth.shape
        inside = (own > 0.0) & (pixel >= 0.0).all(axis=1) & (pixel < (width, height)).all(axis=1)
        column, row = np.where(inside[:, None], pixel, 0.0).astype(int).T
        return np.where(inside, self.depth[row, column], np.nan).astype(np.float64), own

    def ahead(self, x: Doubles, y: Doubles, z: Doubles) -> Floats:
        """(X, Y, Z): how far the surface that is seen lies behind the places of a grid, by depth; infinity where there
        is none in their direction, NaN beside the image."""
        M = (self.camera.matrix @ self.camera.T_camera_world[:3]).astype(np.float32)
        x, y, z = (axis.astype(np.float32) for axis in (x, y, z))  # type: ignore[assignment]
        u, v, own = ((row[0] * x)[:, None, None] + (row[1] * y)[:, None] + (row[2] * z + row[3]) for row in M)
        height, width = self.depth.shape
        inside = (own > 0.0) & (u >= 0.0) & (v >= 0.0) & (u < width * own) & (v < height * own)
        with np.errstate(all="ignore"):
            column, row = (np.where(inside, part / own, 0.0).astype(np.int32) for part in (u, v))
        column, row = np.minimum(column, width - 1), np.minimum(row, height - 1)
        there = np.where(self.depth > 0.0, self.depth, np.float32(np.inf))[row, column]
        return np.where(inside, there - own, np.float32(np.nan)).astype(np.float32)


def drawn(splats: Prepared, cameras: list[Camera], voxel: float, workers: int) -> list[Seen]:
    """The images of all cameras, ``workers`` at a time: numpy lets others run meanwhile."""
    with ThreadPoolExecutor(max(workers, 1)) as pool:
        images = pool.map(lambda camera: depth_image(splats, camera, _LAYER * voxel), cameras)
        return [Seen(camera, *image) for camera, image in zip(cameras, images, strict=True)]


def agreed(views: list[Seen], voxel: float, alone: bool) -> tuple[list[Seen], float]:
    """The views without depths that more of the other views see through than confirm; and the share that went.

    A depth stays that no other view can judge. alone: whether there is nothing behind the object, so that a view
    without a depth looks through too.
    """
    places = np.array([np.linalg.inv(view.camera.T_camera_world)[:3, 3] for view in views])
    kept, lost, total = [], 0, 0
    for number, view in enumerate(views):
        order = np.argsort(np.linalg.norm(places - places[number], axis=1), kind="stable")
        where = np.flatnonzero(view.depth > 0.0)
        points = view.ends().reshape(-1, 3)[where]
        confirm, deny = np.zeros(len(where), np.int32), np.zeros(len(where), np.int32)
        for other in order[1 : _OTHERS + 1]:
            there, own = views[other].depth_at(points)
            slack = np.maximum(_AGREE * own, _AGREE_VOXELS * voxel)
            confirm += (there > 0.0) & (np.abs(there - own) < slack)
            deny += (there > own + slack) if not alone else (there > own + slack) | (there == 0.0)
        wrong = deny > np.maximum(confirm, _LEAST_AGREEING - 1)
        depth = view.depth.copy()
        depth.reshape(-1)[where[wrong]] = 0.0
        kept.append(Seen(view.camera, depth, view.color))
        lost, total = lost + int(wrong.sum()), total + len(where)
    return kept, lost / max(total, 1)
