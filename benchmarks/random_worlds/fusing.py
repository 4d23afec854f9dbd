"""Truncated signed distances fused from depth images by Open3D, written as its users write them."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation

from benchmarks.random_worlds.mesh import Array, ExactScene, ExactView
from benchmarks.worlds.rendering import Size, intrinsics_of, jumps
from regnf_core.importing.fusing import BlockGrid, open3d
from regnf_data.fusing import fuse_blocks, import_own
from regnf_data.posed_images import PosedImages

# Errors of the camera's estimated poses, and where they carry what was measured.

LARGEST = 0.01
"""Deviation of the drift, a share of the distance to what is watched."""
_WATCHED_M = 1.5
_FREE_SHARE = 0.45
_CORRELATED = 0.12
"""Over what share of the walk errors are alike."""


def draw_drift(rng: np.random.Generator) -> float:
    """0 for nearly half of the worlds, else up to 1 %, small ones as often as large ones on a scale of ratios."""
    if rng.random() < _FREE_SHARE:
        return 0.0
    return float(LARGEST * 10.0 ** rng.uniform(-1.3, 0.0))


def drifted(poses: Array, drift: float, rng: np.random.Generator) -> Array:
    """(N, 4, 4): errors E of poses (N, 4, 4): the estimated pose is E T. They wander; a map's loop closures bound them.

    A place 1.5 m off is carried ``drift`` times 1.5 m astray, in the deviation; half of it by the turns.
    """
    errors = np.tile(np.eye(4), (len(poses), 1, 1))
    if drift == 0.0 or len(poses) < 2:
        return errors
    wide = max(_CORRELATED * len(poses), 1.0)
    wander = ndimage.gaussian_filter1d(rng.normal(size=(len(poses), 6)), wide, axis=0, mode="nearest")
    wander /= np.sqrt((wander**2).mean())
    turns = Rotation.from_rotvec(drift * np.sqrt(0.25) * wander[:, :3]).as_matrix()
    centers = poses[:, :3, 3]
    errors[:, :3, :3] = turns
    shifts = drift * _WATCHED_M * np.sqrt(0.25) * wander[:, 3:]
    errors[:, :3, 3] = centers - np.einsum("nij,nj->ni", turns, centers) + shifts
    return errors


def mean_motion(errors: Array, weights: Array, points: Array) -> tuple[Array, float]:
    """The rigid motion (4, 4) that carries points (P, 3) as the errors (N, 4, 4) do on the mean, by weights (N,), and

    the root mean square distance by which single errors carry them elsewhere.
    """
    share = weights / weights.sum()
    carried = np.einsum("nij,pj->npi", errors[:, :3, :3], points) + errors[:, None, :3, 3]
    mean = np.einsum("n,npi->pi", share, carried)
    spread = float(np.sqrt(np.einsum("n,npi->", share, (carried - mean) ** 2) / len(points)))
    source, target = points.mean(axis=0), mean.mean(axis=0)
    U, _, Vt = np.linalg.svd((points - source).T @ (mean - target))
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(Vt.T @ U.T))])
    motion = np.eye(4)
    motion[:3, :3] = Vt.T @ flip @ U.T
    motion[:3, 3] = target - motion[:3, :3] @ source
    return motion, spread


# Depth cameras drawn at random: structured light, time of flight, stereo; what each misses and how it errs.
#
# And the camera of simulated datasets, which errs little or not at all.

Principle = Literal["structured light", "time of flight", "stereo", "rendered"]
PRINCIPLES: tuple[Principle, ...] = ("structured light", "time of flight", "stereo")
SIZES: tuple[Size, ...] = ((120, 160), (240, 320), (480, 640))
_SIZE_SHARES = (0.3, 0.55, 0.15)
PLAIN, BLACK, GLOSSY = 0, 1, 2
_MATTER_SHARES = (0.82, 0.1, 0.08)
_EDGE_M = 0.04


@dataclass(frozen=True)
class RandomSensor:
    """A depth camera. noise: deviation at depth z is noise[0] + noise[1] z + noise[2] z^2 meters.

    step: readings are multiples of step z^2 (parallax) or of step (time of flight, rendered) · grain: over how many
    pixels of an image 640 wide errors are alike · edge_loss: share of the readings lost at jumps · mixed: share of
    those at jumps that lie between both sides · black_loss, glossy_loss: shares of the readings lost on such surfaces.
    """

    principle: Principle
    size: Size
    field_of_view_deg: float
    nearest_m: float
    farthest_m: float
    noise: tuple[float, float, float]
    step: float
    grain: float
    edge_loss: float
    mixed: float
    black_loss: float
    glossy_loss: float
    grazing_deg: float

    @property
    def intrinsics(self) -> Array:
        """(3, 3)."""
        return intrinsics_of(self.size, self.field_of_view_deg)

    def deviation_m(self, depth: Array) -> Array:
        """Of readings at depths in meters."""
        level, linear, square = self.noise
        spread: Array = level + linear * depth + square * depth**2
        return spread

    def measure(self, view: ExactView, matter: NDArray[np.int64], rng: np.random.Generator) -> Array:
        """(H, W) meters, 0 where nothing is read. matter: of each thing, PLAIN, BLACK or GLOSSY."""
        exact, shape = view.depth, view.depth.shape
        edge = jumps(exact, _EDGE_M)
        of_pixel = np.where(view.thing >= 0, matter[view.thing], PLAIN)
        loss = np.where(edge, self.edge_loss, 0.0)
        loss = np.maximum(loss, np.where(of_pixel == BLACK, self.black_loss, 0.0))
        # Glossy surfaces fail in patches, and where they mirror the lamp beside the camera.
        patches = ndimage.gaussian_filter(rng.normal(size=shape), shape[1] / 40.0)
        glossy = (patches > 0.0) | (view.cosine > 0.97)
        loss = np.maximum(loss, np.where((of_pixel == GLOSSY) & glossy, self.glossy_loss, 0.0))
        lost = (rng.random(shape) < loss) | (view.cosine < np.cos(np.radians(self.grazing_deg))) | (exact <= 0.0)
        # Only where both sides are: nothing lies between a surface and no reading.
        between = edge & (ndimage.minimum_filter(exact, 3) > 0.0) & (rng.random(shape) < self.mixed)
        seen = np.where(between, ndimage.uniform_filter(exact, 3), exact)
        read = seen + self.deviation_m(seen) * self._grainy(shape, rng)
        read = self._rounded(read)
        lost |= (read < self.nearest_m) | (read > self.farthest_m)
        return np.where(lost, 0.0, read)

    def _grainy(self, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
        """Errors of deviation 1, alike over ``grain`` pixels."""
        white = rng.normal(size=shape)
        width = self.grain * shape[1] / 640.0
        if width < 0.3:
            return white
        smooth = ndimage.gaussian_filter(white, width)
        grainy: Array = smooth / smooth.std()
        return grainy

    def _rounded(self, read: Array) -> Array:
        if self.step <= 0.0:
            return read
        if self.principle in ("time of flight", "rendered"):
            return np.asarray(np.round(read / self.step) * self.step)
        inverse = np.divide(1.0, read, out=np.zeros_like(read), where=read > 0.05)
        steps = np.round(inverse / self.step) * self.step
        return np.divide(1.0, steps, out=np.zeros_like(read), where=steps > 0.0)


def draw_sensor(rng: np.random.Generator, size: Size | None = None) -> RandomSensor:
    """A camera of the kinds that are sold. size: instead of a random one."""
    principle = PRINCIPLES[int(rng.choice(3, p=(0.45, 0.3, 0.25)))]
    size = size or SIZES[int(rng.choice(3, p=_SIZE_SHARES))]
    loss = {"edge_loss": rng.uniform(0.1, 0.6), "grazing_deg": rng.uniform(72.0, 85.0)}
    loss |= {"black_loss": rng.uniform(0.2, 0.95), "glossy_loss": rng.uniform(0.2, 0.9)}
    if principle == "structured light":
        # Nguyen, Izadi and Lovell (2012) for the first Kinect, a little better to somewhat worse.
        noise = (rng.uniform(0.0006, 0.0015), 0.0, rng.uniform(0.0008, 0.0028))
        angles, reach, step, grain, mixed = (55.0, 62.0), (0.35, 5.0), rng.uniform(0.0008, 0.003), 1.2, 0.0
    elif principle == "time of flight":
        noise = (rng.uniform(0.001, 0.003), rng.uniform(0.0005, 0.002), rng.uniform(0.0, 0.0008))
        angles, reach, step, grain, mixed = (62.0, 76.0), (0.2, 5.0), 0.001, 0.5, rng.uniform(0.03, 0.25)
    else:
        noise = (rng.uniform(0.0003, 0.001), 0.0, rng.uniform(0.001, 0.004))
        angles, reach, step, grain, mixed = (
            (65.0, 88.0),
            (0.25, 6.0),
            rng.uniform(0.0003, 0.002),
            3.5,
            rng.uniform(0.1, 0.4),
        )
    return RandomSensor(
        principle, size, rng.uniform(*angles), reach[0], reach[1], noise, step, grain, mixed=mixed, **loss
    )


def rendered_sensor(rng: np.random.Generator, size: Size | None = None) -> RandomSensor:
    """The camera of a simulated dataset: exact, or with the errors of ``benchmarks.worlds.rendering.DepthSensor``.

    It misses no matter. size: instead of a random one.
    """
    size = size or SIZES[int(rng.choice(3, p=_SIZE_SHARES))]
    field_of_view, exact = rng.uniform(55.0, 75.0), rng.random() < 0.5
    # .0012 + .0019 (z - .4)^2, multiplied out.
    noise = (0.0, 0.0, 0.0) if exact else (0.001504, -0.00152, 0.0019)
    step, edge_loss, grazing_deg = (0.0, 0.0, 90.0) if exact else (0.001, 0.2, 80.0)
    return RandomSensor(
        "rendered", size, field_of_view, 0.05, 9.0, noise, step, 0.0, edge_loss, 0.0, 0.0, 0.0, grazing_deg
    )


def draw_matter(count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """(count,): PLAIN, BLACK or GLOSSY for each thing."""
    return np.asarray(rng.choice((PLAIN, BLACK, GLOSSY), size=count, p=_MATTER_SHARES), dtype=np.int64)


# Depth images of a world along a walk, and what they show of each thing.

Group = tuple[int, Array, Array]
"""A thing's number, and points (P, 3) of its surface with their normals (P, 3)."""

_GOLDEN = 0.618034
_DEPTH_SHARE, _DEPTH_M = 0.01, 0.004
"""How far from a reading's exact depth a point may lie that counts as the one seen."""


@dataclass(frozen=True, eq=False)
class Capture:
    """What N images show.

    depths: (N, H, W) float32 meters, 0 where nothing is read · shades: (N, H, W) uint8, a gray a thing, lit from the
    camera · poses: (N, 4, 4) true · errors: (N, 4, 4): the poses that a map is made with are E T · seen: for each group
    of points, (P,) in how many images each was measured from its front · shows: for each group, (N,) how many of its
    points each image shows.
    """

    sensor: RandomSensor
    depths: NDArray[np.float32]
    shades: NDArray[np.uint8]
    poses: Array
    errors: Array
    seen: tuple[NDArray[np.int64], ...]
    shows: tuple[NDArray[np.int64], ...]

    @property
    def estimated(self) -> Array:
        """(N, 4, 4)."""
        return self.errors @ self.poses

    def images(self, bounds: Array, every: int = 1) -> PosedImages:
        """The images as a dataset's; bounds: (2, 3) of the world."""
        depths = self.depths[::every]
        poses = self.estimated[::every]
        return PosedImages(
            colors=np.repeat(self.shades[::every, ..., None], 3, axis=-1),
            intrinsics=np.tile(self.sensor.intrinsics, (len(poses), 1, 1)),
            T_world_camera=poses,
            bounds=bounds,
            depths=depths,
        )

    def carried(self, group: int, points: Array) -> tuple[Array, float]:
        """Where the drift carries a group's points, on the mean over the images that show it: see ``mean_motion``."""
        weights = self.shows[group].astype(np.float64)
        if weights.sum() == 0.0:
            return np.eye(4), 0.0
        return mean_motion(self.errors, weights, points)


def capture(
    scene: ExactScene,
    sensor: RandomSensor,
    poses: Array,
    errors: Array,
    groups: Sequence[Group],
    matter: NDArray[np.int64],
    rng: np.random.Generator,
) -> Capture:
    """Images from the true poses. groups: what the images are asked for · matter: of each thing."""
    ends = np.cumsum([0, *(len(points) for _, points, _ in groups)])
    asked = _Asked(
        np.concatenate([np.zeros((0, 3)), *(points for _, points, _ in groups)]),
        np.concatenate([np.zeros((0, 3)), *(normals for _, _, normals in groups)]),
        np.repeat([thing for thing, _, _ in groups], np.diff(ends)).astype(np.int64),
    )
    depths = np.zeros((len(poses), *sensor.size), np.float32)
    shades = np.zeros(depths.shape, np.uint8)
    seen = np.zeros(ends[-1], np.int64)
    shows = np.zeros((len(groups), len(poses)), np.int64)
    for number, pose in enumerate(poses):
        view = scene.view(sensor.size, sensor.intrinsics, pose)
        depths[number] = sensor.measure(view, matter, rng)
        shades[number] = np.where(
            view.thing >= 0, 250.0 * view.cosine * (0.4 + 0.6 * (view.thing * _GOLDEN % 1.0)), 0.0
        )
        now = _measured(asked, pose, sensor, (view.depth, view.thing, depths[number]))
        seen += now
        shows[:, number] = [now[a:b].sum() for a, b in pairwise(ends)]
    parts = tuple(seen[a:b] for a, b in pairwise(ends))
    return Capture(sensor, depths, shades, poses, errors, parts, tuple(shows))


@dataclass(frozen=True, eq=False)
class _Asked:
    """Points (P, 3), their normals (P, 3) and the things (P,) that they belong to."""

    points: Array
    normals: Array
    owners: NDArray[np.int64]


def _measured(
    asked: _Asked,
    pose: Array,
    sensor: RandomSensor,
    images: tuple[Array, NDArray[np.int64], NDArray[np.float32]],
) -> NDArray[np.bool_]:
    """(P,): which points one image has readings of, from their front: what shows its back, as an open sheet may, is
    measured, but not as the object's own surface. images: exact depths, things, readings."""
    depth, thing, reading = images
    away = asked.points - pose[:3, 3]
    local = away @ pose[:3, :3]
    z = np.maximum(local[:, 2], 1e-6)
    K, (height, width) = sensor.intrinsics, sensor.size
    column = np.floor(K[0, 0] * local[:, 0] / z + K[0, 2])
    row = np.floor(K[1, 1] * local[:, 1] / z + K[1, 2])
    found: NDArray[np.bool_] = (local[:, 2] > 0.05) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    found &= (away * asked.normals).sum(axis=1) < 0.0
    at = np.flatnonzero(found)
    places = row[at].astype(np.int64), column[at].astype(np.int64)
    same = (thing[places] == asked.owners[at]) & (np.abs(depth[places] - z[at]) < _DEPTH_SHARE * z[at] + _DEPTH_M)
    found[at] = same & (reading[places] > 0.0)
    return found


Volume = Literal["blocks", "dense"]
LARGEST_DENSE = 200
"""Voxels along an edge of a dense grid."""
_DENSE_IMAGES = 40


@dataclass(frozen=True)
class Fusion:
    """voxel_m: from node to node · truncation: voxels · volume: Open3D's VoxelBlockGrid, or one dense grid."""

    voxel_m: float
    truncation: float
    volume: Volume
    farthest_m: float


def fuse(taken: Capture, fusion: Fusion, bounds: Array, path: Path) -> None:
    """Write the safe field of the fused images to ``path``, imported from the file that a user would upload.

    bounds: (2, 3), what a dense grid covers. Raises DatasetError where nothing was measured.
    """
    if fusion.volume == "blocks":
        intrinsics = np.tile(taken.sensor.intrinsics, (len(taken.poses), 1, 1))
        grid = BlockGrid(fusion.voxel_m, fusion.truncation, fusion.farthest_m)
        fuse_blocks(taken.depths, intrinsics, taken.estimated, grid, path)
        return
    source = path.with_suffix(".npz")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        _save_dense(taken, fusion, bounds, source)
    import_own(source, path, {})
    source.unlink()


def write_dense(path: Path, values: NDArray[np.float32], origin: Array, spacing: float) -> None:
    """Write the safe field of distances at the nodes (X, Y, Z) of a grid to ``path``."""
    source = path.with_suffix(".npz")
    np.savez(source, sdf=values, origin=origin, spacing=np.float64(spacing))
    import_own(source, path, {})
    source.unlink()


def _save_dense(taken: Capture, fusion: Fusion, bounds: Array, path: Path) -> None:
    o3d = open3d()
    length = float((bounds[1] - bounds[0]).max())
    count = min(int(np.ceil(length / fusion.voxel_m)), LARGEST_DENSE)
    every = max(1, len(taken.poses) // _DENSE_IMAGES)
    volume = o3d.pipelines.integration.UniformTSDFVolume(
        length=length,
        resolution=count,
        sdf_trunc=fusion.truncation * length / count,
        color_type=o3d.pipelines.integration.TSDFVolumeColorType.NoColor,
        origin=bounds[0],
    )
    height, width = taken.sensor.size
    K = taken.sensor.intrinsics
    # Of this volume's images, whole numbers are the middles of pixels.
    camera = o3d.camera.PinholeCameraIntrinsic(width, height, K[0, 0], K[1, 1], K[0, 2] - 0.5, K[1, 2] - 0.5)
    color = o3d.geometry.Image(np.zeros((height, width, 3), np.uint8))
    for depth, pose in zip(taken.depths[::every], taken.estimated[::every], strict=True):
        image = o3d.geometry.Image(np.ascontiguousarray(depth))
        both = o3d.geometry.RGBDImage.create_from_color_and_depth(color, image, 1.0, fusion.farthest_m, True)
        volume.integrate(both, camera, np.linalg.inv(pose))
    values = np.asarray(volume.extract_volume_tsdf())  # (count^3, 2)
    tsdf, weight = values.reshape(count, count, count, 2).transpose(3, 0, 1, 2)
    voxel = length / count
    np.savez(
        path,
        sdf=(tsdf * fusion.truncation * voxel).astype(np.float32),
        weight=weight.astype(np.float32),
        origin=np.asarray(bounds[0]) + voxel / 2.0,
        spacing=np.float64(voxel),
    )
