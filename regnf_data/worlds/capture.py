"""Depth images of a world along a walk, and what they show of each thing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from regnf_data.posed_images import PosedImages
from regnf_data.worlds.drift import mean_motion
from regnf_data.worlds.exact import ExactScene
from regnf_data.worlds.mesh import Array
from regnf_data.worlds.sensors import RandomSensor

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
