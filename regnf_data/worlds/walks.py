"""How a camera goes through a world, drawn at random: walks, orbits, passes, single views."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from regnf_core.errors import DatasetError
from regnf_data.trajectories import CLEARANCE_M, long_walk, look_at, short_walk
from regnf_data.walking import WalkingGround
from regnf_data.worlds.exact import ExactScene
from regnf_data.worlds.mesh import Array
from regnf_data.worlds.rooms import World

Length = Literal["long", "short", "single"]
LENGTHS: tuple[Length, ...] = ("long", "short", "single")
_GAZE_M = 1.6
_ROBOT_M = (0.28, 0.6)
_LEAST_SHOWN = 0.2
"""Of a thing, in a single view of it."""
_JITTER_DEG, _JITTER_M = 1.5, 0.008


def walk(world: World, scene: ExactScene, length: Length, frames: int, rng: np.random.Generator) -> tuple[str, Array]:
    """The walk's name and its poses (frames, 4, 4). Raises DatasetError (DATASET_NO_FREE_PATH)."""
    if length == "single":
        return "single", _single(world, scene, rng)
    if world.focus is not None:
        name, poses = _round_focus(world, scene, length, frames, rng)
    else:
        name, poses = _through_room(world, scene, length, frames, rng)
    if rng.random() < 0.5:
        return f"{name}, jittered", _jittered(poses, rng)
    return name, poses


def _through_room(
    world: World, scene: ExactScene, length: Length, frames: int, rng: np.random.Generator
) -> tuple[str, Array]:
    ground = WalkingGround(scene, world.floor)
    boxes = [thing.mesh.bounds for thing in world.things if thing.model is not None and thing.model.big]
    boxes = boxes or [thing.mesh.bounds for thing in world.things]
    if length == "long":
        poses = long_walk(ground, boxes, frames)
        if rng.random() < 0.25:
            return "robot", _lowered(poses, rng.uniform(*_ROBOT_M))
        return "long", poses
    if rng.random() < 0.5:
        return "short", short_walk(ground, boxes, frames)
    sides = ground.sides()
    path = sides[int(rng.integers(len(sides)))]
    target = np.mean([box.mean(axis=0) for box in boxes], axis=0)
    along = path[np.linspace(0, len(path) - 1, frames).astype(np.int64)]
    positions = np.concatenate([along, np.full((frames, 1), rng.uniform(1.2, 1.7))], axis=1)
    return "one side", look_at(positions, np.tile(target, (frames, 1)))


def _round_focus(
    world: World, scene: ExactScene, length: Length, frames: int, rng: np.random.Generator
) -> tuple[str, Array]:
    """An orbit of a table, an arc before a shelf; a short one is an arc of 50 to 120 degrees."""
    assert world.focus is not None
    low, high = world.focus.mesh.bounds
    shelf = world.kind == "shelf"
    reach = 0.5 * float(np.linalg.norm((high - low)[:2])) + (rng.uniform(0.8, 1.1) if shelf else rng.uniform(0.45, 0.8))
    middle = (low + high)[:2] / 2.0
    whole = math.radians(150.0) if shelf else 2.0 * math.pi
    arc = whole if length == "long" else math.radians(rng.uniform(50.0, 120.0))
    start = -math.pi / 2.0 - arc / 2.0 if shelf else rng.uniform(0.0, 2.0 * math.pi)
    if shelf:
        levels = np.linspace(low[2] + 0.25, high[2] + 0.15, 3 if length == "long" else 1)
        targets = np.clip(levels, low[2] + 0.1, high[2])
        if length == "short":
            levels, targets = np.array([rng.uniform(0.6, 1.1) * high[2] + 0.1]), np.array([0.5 * high[2]])
    else:
        levels = high[2] + (np.array([0.3, 0.8]) if length == "long" else rng.uniform(0.25, 0.8, 1))
        targets = np.full(len(levels), high[2] + 0.05)
    poses = []
    for level, target, count in zip(levels, targets, _shared(frames, len(levels)), strict=True):
        angles = start + arc * np.linspace(0.0, 1.0, count)
        ring = middle + reach * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        positions = np.concatenate([ring, np.full((count, 1), level)], axis=1)
        poses.append(look_at(positions, np.tile([*middle, target], (count, 1))))
    return ("orbit" if length == "long" else "arc"), _free(scene, world, np.concatenate(poses))


def _single(world: World, scene: ExactScene, rng: np.random.Generator) -> Array:
    """(1, 4, 4): a look at one of the things, nearly filling the picture or farther off."""
    things = [thing for thing in world.things if thing is not world.focus]
    for _ in range(200):
        thing = things[int(rng.integers(len(things)))]
        low, high = thing.mesh.bounds
        reach = max(rng.uniform(1.0, 2.2) * float(np.linalg.norm(high - low)), 0.6)
        azimuth, rise = rng.uniform(0.0, 2.0 * math.pi), math.radians(rng.uniform(5.0, 60.0))
        out = np.array([math.cos(azimuth) * math.cos(rise), math.sin(azimuth) * math.cos(rise), math.sin(rise)])
        target = (low + high) / 2.0
        pose = look_at((target + reach * out)[None], (target + rng.normal(scale=0.05, size=3))[None])
        shown = scene.sees(np.tile(pose[0, :3, 3], (len(thing.points), 1)), thing.points).mean()
        if shown >= _LEAST_SHOWN and len(_free_ones(scene, world, pose)):
            return pose
    raise DatasetError("nowhere to look from", reason="DATASET_NO_FREE_PATH")


def _lowered(poses: Array, height: float) -> Array:
    """The same walk at a robot's height, looking at the same places."""
    targets = poses[:, :3, 3] + _GAZE_M * poses[:, :3, 2]
    targets[:, 2] = np.clip(targets[:, 2], 0.15, 1.0)
    positions = poses[:, :3, 3].copy()
    positions[:, 2] = height
    return look_at(positions, targets)


def _jittered(poses: Array, rng: np.random.Generator) -> Array:
    """The poses shaken as a hand shakes them."""
    turns = ndimage.gaussian_filter1d(rng.normal(size=(len(poses), 3)), 1.0, axis=0) * 1.9
    shifts = ndimage.gaussian_filter1d(rng.normal(size=(len(poses), 3)), 1.0, axis=0) * 1.9
    shaken = poses.copy()
    shaken[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(np.radians(_JITTER_DEG) * turns).as_matrix()
    shaken[:, :3, 3] += _JITTER_M * shifts
    return shaken


def _free(scene: ExactScene, world: World, poses: Array) -> Array:
    kept = _free_ones(scene, world, poses)
    if len(kept) < max(4, len(poses) // 3):
        raise DatasetError("the camera's way is barred", reason="DATASET_NO_FREE_PATH")
    return kept


def _free_ones(scene: ExactScene, world: World, poses: Array) -> Array:
    """The poses whose camera is clear of everything, within the room, and not in matter."""
    positions = poses[:, :3, 3]
    clear = (scene.distance(positions) > CLEARANCE_M) & (positions[:, 2] > CLEARANCE_M)
    inside = ((positions > world.floor[0]) & (positions < world.floor[1] + (0.0, 0.0, 9.0))).all(axis=1)
    up = np.tile((0.0, 0.0, 40.0), (len(poses), 1))
    free: Array = poses[clear & inside & scene.sees(positions, positions + up)]
    return free


def _shared(count: int, parts: int) -> list[int]:
    return [count // parts + (part < count % parts) for part in range(parts)]
