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
_SIDE = 256
"""Pixels along an image's side."""
_PLACES, _CELLS = 16, 48
"""Places within a scene, six views each; cells along the longest edge, in which they are looked for."""
_FULL = 0.5
"""A cell is matter where the splats in it stop so much light."""
_ENCLOSED = 0.5
"""Places from which at least this share of what the most enclosed place has is matter, of the directions of view."""
_CLEARANCE = 2.0
"""Cells between a place and matter."""
_CANDIDATES, _RAYS, _STEP = 400, 600, 0.7
"""Places that are tried, rays from each, and cells from step to step along a ray."""
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
_SAME = 1.5
"""Voxels: depths from two sides that agree so well are of one layer."""
_MOST_BACKS = 0.1
"""Of what is seen from a place: no camera was where more is."""
_TRIED = 200
"""Places that a view sees, by which others are found that see them too."""


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
        height = int(min(_SIDE, np.sqrt(pixels / aspect)))
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
        focal = _SIDE / float((high - low).max())
        x, y = _SIDE / 2 - focal * (low + high) / 2
        found.append(Camera(T, (focal, focal), (float(x), float(y)), (_SIDE, _SIDE)))
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
    half = _SIDE / 2
    sides = [sign * axis for axis in np.eye(3) for sign in (1.0, -1.0)]
    return [
        Camera(_looking(place, side), (half, half), (half, half), (_SIDE, _SIDE))
        for place in _free_places(splats, region)
        for side in sides
    ]


def _free_places(splats: Splats, region: Region) -> Doubles:
    """(P, 3): places in cells without matter that are enclosed by it, from which together most of it is seen."""
    cell = region.longest / _CELLS
    shape = np.maximum(np.ceil((region.high - region.low) / cell), 1).astype(int)
    index = np.floor((splats.means - region.low) / cell).astype(int)
    kept = ((index >= 0) & (index < shape)).all(axis=1)
    stopped = np.zeros(shape)
    area = np.exp(2.0 * np.sort(splats.scales[kept].astype(np.float64), axis=1)[:, 1:].mean(axis=1))
    share = splats.opacities[kept] * np.minimum(2.0 * np.pi * area / cell**2, 1.0)
    np.add.at(stopped, tuple(index[kept].T), share)
    matter = 1.0 - np.exp(-stopped) > _FULL
    enclosed = _share_enclosed(matter)
    room = ndimage.distance_transform_edt(np.pad(~matter, 1, constant_values=True))[1:-1, 1:-1, 1:-1]
    good = (room >= _CLEARANCE) & (enclosed >= _ENCLOSED * enclosed[~matter].max(initial=0.0))
    cells = np.argwhere(good if good.any() else ~matter)
    cells = np.random.default_rng(0).permutation(cells)[:_CANDIDATES]
    seen = _cells_seen(matter, cells)
    chosen: list[int] = []
    worth = np.ones(matter.size + 1)
    worth[-1] = 0.0
    while len(chosen) < min(_PLACES, len(cells)):
        gain = np.array([worth[own].sum() for own in seen])
        gain[chosen] = 0.0
        if gain.max(initial=0.0) == 0.0:
            break
        chosen.append(int(gain.argmax()))
        worth[seen[chosen[-1]]] *= 0.5
    return region.low + cell * (cells[chosen] + 0.5)


def _cells_seen(matter: npt.NDArray[np.bool_], cells: npt.NDArray[np.int64]) -> list[npt.NDArray[np.int64]]:
    """For each of the cells (C, 3) without matter, the numbers of cells with matter where rays from it end."""
    rays = directions(_RAYS)
    hit = np.full((len(cells), len(rays)), matter.size)
    for step in np.arange(1.0, np.linalg.norm(matter.shape), _STEP):
        at = np.floor(cells[:, None] + 0.5 + step * rays).astype(np.int64)
        within = ((at >= 0) & (at < matter.shape)).all(axis=-1)
        number = np.ravel_multi_index(tuple(np.where(within[..., None], at, 0).transpose(2, 0, 1)), matter.shape)
        ends = within & matter.reshape(-1)[number] & (hit == matter.size)
        hit[ends] = number[ends]
    return [np.unique(own) for own in hit]


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


_Places = tuple[npt.NDArray[np.int64], Floats, Floats]


@dataclass(frozen=True, eq=False)
class Seen:
    """What a camera sees: depths (H, W), 0 where nothing stops the light and NaN where it cannot tell; colors
    (H, W, 3), if they are known."""

    camera: Camera
    depth: Floats
    color: npt.NDArray[np.uint8] | None

    @property
    def place(self) -> Doubles:
        """(3,): of the camera, in the world."""
        T = self.camera.T_camera_world
        place: Doubles = -T[:3, :3].T @ T[:3, 3]
        return place

    def seen_places(self) -> _Places:
        """The pixels (M,) with a depth; where the depths end (M, 3), and normals there of any length that face the
        camera (M, 3), in the world."""
        ends, where = self.ends(), np.flatnonzero(self.depth > 0.0)
        steps = []
        for axis in (0, 1):
            step = np.diff(ends, axis=axis)
            before = np.concatenate([np.take(step, [0], axis), step], axis)
            after = np.concatenate([step, np.take(step, [-1], axis)], axis)
            shorter = (before**2).sum(-1, keepdims=True) < (after**2).sum(-1, keepdims=True)
            steps.append(np.where(shorter, before, after).reshape(-1, 3)[where])
        normals, points = np.cross(steps[0], steps[1]), ends.reshape(-1, 3)[where]
        facing = ((self.place - points) * normals).sum(-1, keepdims=True)
        return where, points.astype(np.float32), np.where(facing < 0.0, -normals, normals).astype(np.float32)

    def ends(self) -> Doubles:
        """(H, W, 3): where the depths end, in the world; the camera's place where there is none."""
        row, column = np.indices(self.depth.shape) + 0.5
        pixels = np.stack([column, row, np.ones_like(row)], axis=-1)
        local = self.depth[..., None] * (pixels @ np.linalg.inv(self.camera.matrix).T)
        T = np.linalg.inv(self.camera.T_camera_world)
        ends: Doubles = local @ T[:3, :3].T + T[:3, 3]
        return ends

    def depth_at(self, points: Floats) -> tuple[Floats, Floats]:
        """(M,): the depths in the directions of points (M, 3), 0 where there is none, NaN beside the image; and the
        points' own."""
        M = (self.camera.matrix @ self.camera.T_camera_world[:3]).astype(np.float32)
        u, v, own = M[:, :3] @ points.T + M[:, 3:]
        height, width = self.depth.shape
        inside = (own > 0.0) & (u >= 0.0) & (v >= 0.0) & (u < width * own) & (v < height * own)
        with np.errstate(all="ignore"):
            column, row = (np.where(inside, part / own, 0.0).astype(np.int32) for part in (u, v))
        column, row = np.minimum(column, width - 1), np.minimum(row, height - 1)
        return np.where(inside, self.depth[row, column], np.float32(np.nan)), own

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
        there = np.where(self.depth == 0.0, np.float32(np.inf), self.depth)[row, column]
        return np.where(inside, there - own, np.float32(np.nan)).astype(np.float32)


def drawn(splats: Prepared, cameras: list[Camera], voxel: float, workers: int) -> list[Seen]:
    """The images of all cameras, ``workers`` at a time: numpy lets others run meanwhile."""
    with ThreadPoolExecutor(max(workers, 1)) as pool:
        images = pool.map(lambda camera: depth_image(splats, camera, _LAYER * voxel), cameras)
        return [Seen(camera, *image) for camera, image in zip(cameras, images, strict=True)]


def agreed(views: list[Seen], voxel: float, alone: bool, placed: bool) -> tuple[list[Seen], float]:
    """The views without depths that more of the other views see through than confirm; and the share that went.

    A depth stays that no other view can judge. alone: whether there is nothing behind the object, so that a view
    without a depth looks through too · placed: whether the cameras of the training are not known. Then depths at backs
    become NaN, and places in a scene from which many backs are seen are left out: splats look the same from behind,
    where no camera of the training was, but what it would have seen there is missing.
    """
    places = [view.seen_places() for view in views]
    overlap = _overlap(views, places)
    kept, lost, total = [], 0, 0
    for number, (view, (where, points, normals)) in enumerate(zip(views, places, strict=True)):
        confirm, deny, behind = (np.zeros(len(where), np.int32) for _ in range(3))
        for other in np.argsort(-overlap[number], kind="stable")[:_OTHERS]:
            there, own = views[other].depth_at(points)
            off, slack = there - own, np.maximum(_AGREE * own, np.float32(_AGREE_VOXELS * voxel))
            near = there > 0.0
            confirm += near & (np.abs(off) < slack)
            deny += (off > slack) if not alone else (off > slack) | (there == 0.0)
            facing = ((views[other].place.astype(np.float32) - points) * normals).sum(axis=1) > 0.0
            behind += (near & (np.abs(off) < _SAME * voxel)) * np.where(facing, -1, 1)
        wrong = deny > np.maximum(confirm, _LEAST_AGREEING - 1)
        depth = view.depth.copy()
        flat = depth.reshape(-1)
        flat[where[(behind > 0) & placed]] = np.nan
        flat[where[wrong]] = 0.0
        kept.append(Seen(view.camera, depth, view.color))
        lost, total = lost + int(wrong.sum()), total + len(where)
    sound = [view for view in kept if alone or _share_of_backs(view.place, kept) <= _MOST_BACKS]
    return sound or kept, lost / max(total, 1)


def _share_of_backs(place: Doubles, views: list[Seen]) -> float:
    """Of what is seen from a place."""
    depths = np.concatenate([view.depth.ravel() for view in views if np.allclose(view.place, place)])
    return float(np.isnan(depths).sum() / max(np.count_nonzero(depths), 1))


def _overlap(views: list[Seen], places: list[_Places]) -> npt.NDArray[np.int64]:
    """(V, V): of some places that a view sees, how many lie within the other's image; -1 of itself."""
    random, counts = np.random.default_rng(0), np.full((len(views), len(views)), -1)
    for number, (_, points, _) in enumerate(places):
        some = points[random.permutation(len(points))[:_TRIED]]
        for other in range(len(views)):
            if other != number:
                counts[number, other] = np.isfinite(views[other].depth_at(some)[0]).sum()
    return counts
