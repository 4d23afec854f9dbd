"""How the field of a world is made: everything that a seed draws beside the world itself."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from benchmarks.random_worlds.fusing import (
    LARGEST_DENSE,
    Capture,
    Fusion,
    RandomSensor,
    capture,
    draw_drift,
    draw_matter,
    draw_sensor,
    drifted,
    rendered_sensor,
)
from benchmarks.random_worlds.mesh import Array, ExactScene
from benchmarks.random_worlds.walks import LENGTHS, Length, World, walk
from benchmarks.worlds.rendering import Size
from regnf_core.errors import DatasetError

Scene = Literal["tsdf", "rendered", "fused", "rendered-fused", "fit", "rendered-fit", "under-trained", "mesh", "bent"]
SCENES: tuple[Scene, ...] = get_args(Scene)
FROM_IMAGES: tuple[Scene, ...] = ("tsdf", "rendered", "fused", "rendered-fused", "fit", "rendered-fit", "under-trained")
"""Scenes that the poses' drift bends; the others are exact, or bent in another way."""
RENDERED: tuple[Scene, ...] = ("rendered", "rendered-fused", "rendered-fit")
"""Scenes whose images are those of a simulated dataset."""
_FRAMES: dict[Length, dict[int, int]] = {
    "long": {120: 150, 240: 90, 480: 40},
    "short": {120: 48, 240: 32, 480: 16},
    "single": {120: 1, 240: 1, 480: 1},
}
_VOXELS_M = {"room": (0.006, 0.01), "table": (0.003, 0.006), "shelf": (0.0035, 0.007)}
_ABOUT_M = {"room": 0.05, "table": 0.2, "shelf": 0.15}
_FARTHEST_M = {"room": (3.0, 5.0), "table": (1.6, 2.2), "shelf": (2.0, 2.6)}
"""Depths beyond are dropped, as one does whose interest is the table."""
_TRIES = 4
_FEWER = 3
"""Times fewer images of another walk, from which objects are cut."""


def parts_of_name(world: str) -> tuple[str, int, str]:
    """Scene, seed and length of a world, by its name."""
    scene, seed, length = world.rsplit("-", 2)
    return scene, int(seed), length


@dataclass(frozen=True, eq=False)
class Seen:
    """A world as a walk has seen it. name: of the walk · bounds: (2, 3) of what is of interest · rendered: images are
    those of a simulated dataset."""

    name: str
    drift: float
    taken: Capture
    fusion: Fusion
    bounds: Array
    rendered: bool


def see(world: World, length: Length, rendered: bool = False, again: int = 0) -> Seen:
    """A walk of some length through the world with a random sensor; ``again``: another one.

    rendered: with the sensor of simulated datasets, and poses without drift.

    Raises DatasetError (DATASET_NO_FREE_PATH) where there is no way for a camera.
    """
    rng = np.random.default_rng([world.seed, 16, LENGTHS.index(length), again])
    scene = ExactScene([placed.mesh for placed in world.all])
    sensor = rendered_sensor(rng) if rendered else draw_sensor(rng)
    farthest = min(sensor.farthest_m, rng.uniform(*_FARTHEST_M[world.kind]))
    sensor = replace(sensor, farthest_m=farthest)
    frames = _FRAMES[length][sensor.size[0]] // (1 if again == 0 else _FEWER)
    name, poses = _some_walk(world, scene, (length, frames), rng)
    drift = draw_drift(rng) if length != "single" and not rendered else 0.0
    groups = [
        (len(world.fixed) + number, *placed.outside)
        for number, placed in enumerate(world.things)
        if placed.model is not None
    ]
    matter = draw_matter(len(world.all), rng)
    taken = capture(scene, sensor, poses, drifted(poses, drift, rng), groups, matter, rng)
    bounds = _bounds(world)
    return Seen(name, drift, taken, _draw_fusion(world, bounds, sensor, rng), bounds, rendered)


def orbit_sensor(rng: np.random.Generator, diameter: float, rendered: bool) -> RandomSensor:
    """A camera for one object alone; small ones are taken with more pixels. rendered: see :func:`see`."""
    size: Size = (240, 320) if diameter < 0.6 else (120, 160)
    return rendered_sensor(rng, size) if rendered else draw_sensor(rng, size)


def _some_walk(
    world: World, scene: ExactScene, wanted: tuple[Length, int], rng: np.random.Generator
) -> tuple[str, Array]:
    for _ in range(_TRIES - 1):
        try:
            return walk(world, scene, *wanted, rng)
        except DatasetError:
            continue
    return walk(world, scene, *wanted, rng)


def _draw_fusion(world: World, bounds: Array, sensor: RandomSensor, rng: np.random.Generator) -> Fusion:
    """All depths of the sensor are fused: what counts as measured lies in the map."""
    low, high = _VOXELS_M[world.kind]
    voxel = math.exp(rng.uniform(math.log(low), math.log(high)))
    dense = world.kind != "room" and rng.random() < 0.15
    rng.random()  # keeps what follows as it was when the map had a farthest depth of its own
    if dense:
        voxel = max(voxel, float((bounds[1] - bounds[0]).max()) / LARGEST_DENSE)
    return Fusion(voxel, float(rng.uniform(3.0, 8.0)), "dense" if dense else "blocks", sensor.farthest_m)


def _bounds(world: World) -> Array:
    """The room, or what is near the table or the shelf."""
    margin = _ABOUT_M[world.kind]
    if world.focus is None:
        corners = np.concatenate([placed.mesh.bounds for placed in world.all])
    else:
        near = [thing.mesh.bounds for thing in world.things if _near(thing.mesh.bounds, world.focus.mesh.bounds)]
        corners = np.concatenate(near)
    return np.stack([corners.min(axis=0) - margin, corners.max(axis=0) + margin])


def _near(one: Array, other: Array) -> bool:
    return bool((one[0] <= other[1] + 0.1).all() and (one[1] >= other[0] - 0.1).all())
