"""How a camera goes through a world, drawn at random: walks, orbits, passes, single views."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from benchmarks.random_worlds import tables
from benchmarks.random_worlds.mesh import Array, ExactScene, Mesh, box, standing, turn_about_z
from benchmarks.random_worlds.models import Catalog, Model
from benchmarks.random_worlds.placing import GAP_M, Placed, rest, resting_turns, touching
from benchmarks.worlds.trajectories import CLEARANCE_M, WalkingGround, long_walk, look_at, short_walk
from regnf_core.errors import DatasetError

# Random rooms, table tops and shelves, furnished: one seed, one world.

Kind = Literal["room", "table", "shelf"]
KINDS: tuple[Kind, ...] = ("room", "table", "shelf")
_SHARES = (0.6, 0.26, 0.14)
_WALL_M = 0.12
_TRIES = 12
_LARGEST_SHARE = 0.42
"""Of the floor, under furniture: the rest is for walking."""


@dataclass(frozen=True, eq=False)
class World:
    """floor: (2, 3) corners of its slab · fixed: floor and walls · things: what stands there, and what it stands on ·

    focus: what a camera goes round on a table or before a shelf; None in a room.
    """

    seed: int
    kind: Kind
    floor: Array
    fixed: tuple[Placed, ...]
    things: tuple[Placed, ...]
    focus: Placed | None

    @property
    def all(self) -> tuple[Placed, ...]:
        """Floor and walls first."""
        return (*self.fixed, *self.things)


def make_world(seed: int, catalog: Catalog, kind: Kind | None = None) -> World:
    """The world of a seed. kind: instead of the one that the seed draws."""
    rng = np.random.default_rng([seed, 15])
    drawn: Kind = KINDS[int(rng.choice(len(KINDS), p=_SHARES))]
    kind = kind or drawn
    return {"room": _room, "table": _table_top, "shelf": _shelf}[kind](seed, rng, catalog)


def _room(seed: int, rng: np.random.Generator, catalog: Catalog) -> World:
    width, depth, height = rng.uniform(3.2, 5.6), rng.uniform(3.0, 4.8), rng.uniform(2.2, 2.7)
    builder = _Builder(rng, catalog, (width, depth, height), int(rng.integers(2, 5)))
    for _ in range(int(rng.integers(4, 9))):
        if builder.covered > _LARGEST_SHARE * width * depth:
            break
        builder.add_furniture()
    for _ in range(int(rng.integers(4, 11))):
        builder.add_small()
    return builder.world(seed, "room", None)


def _table_top(seed: int, rng: np.random.Generator, catalog: Catalog) -> World:
    builder = _Builder(rng, catalog, (3.6, 3.6, 1.2), int(rng.integers(0, 2)))
    size = (rng.uniform(0.8, 1.5), rng.uniform(0.6, 0.95))
    focus = builder.put(Model("table", standing(tables.table(rng, size))), turn_about_z(rng.uniform(0.0, 6.28)), (0, 0))
    for _ in range(int(rng.integers(5, 14))):
        builder.add_small([focus])
    for _ in range(int(rng.integers(0, 3))):
        builder.add_small()
    return builder.world(seed, "table", focus)


def _shelf(seed: int, rng: np.random.Generator, catalog: Catalog) -> World:
    builder = _Builder(rng, catalog, (3.4, 3.4, 2.4), 1)
    size = (rng.uniform(0.7, 1.4), rng.uniform(0.28, 0.45), rng.uniform(0.8, 1.9))
    model = Model("shelf", standing(tables.shelf(rng, size)))
    # The only wall is the first: y is largest there, and the shelf's back is turned to it.
    place = (rng.uniform(-0.4, 0.4), 1.7 - size[1] / 2.0 - rng.choice([GAP_M, 0.02]))
    focus = builder.put(model, np.eye(4), place)
    for _ in range(int(rng.integers(7, 16))):
        builder.add_small([focus])
    return builder.world(seed, "shelf", focus)


class _Builder:
    """A room that is being furnished. walls: how many of its four sides have one."""

    def __init__(
        self, rng: np.random.Generator, catalog: Catalog, size: tuple[float, float, float], walls: int
    ) -> None:
        self._rng, self._catalog = rng, catalog
        x, y, height = size[0] / 2.0, size[1] / 2.0, size[2]
        self._half = np.array([x, y])
        t = _WALL_M
        self.floor = np.array([[-x, -y, -t], [x, y, 0.0]])
        sides = [
            ((-x, y, -t), (x, y + t, height)), ((-x - t, -y, -t), (-x, y + t, height)),
            ((x, -y, -t), (x + t, y + t, height)), ((-x - t, -y - t, -t), (x + t, -y, height)),
        ]  # fmt: skip
        self._walls = walls
        self.fixed = [_architecture(box(*self.floor)), *(_architecture(box(*side)) for side in sides[:walls])]
        self.things: list[Placed] = []

    @property
    def covered(self) -> float:
        """Square meters of the floor that lie under things."""
        return sum(float(np.prod(thing.mesh.size[:2])) for thing in self.things if thing.model and thing.model.big)

    def world(self, seed: int, kind: Kind, focus: Placed | None) -> World:
        return World(seed, kind, self.floor, tuple(self.fixed), tuple(self.things), focus)

    def put(self, model: Model, turn: Array, place: tuple[float, float]) -> Placed:
        """The first thing, where nothing is in its way."""
        T = turn.copy()
        T[:3, 3] += (*place, GAP_M)
        self.things.append(Placed(model, T, model.mesh.moved(T)))
        return self.things[-1]

    def add_furniture(self) -> None:
        """One big thing: at a wall, in a corner, at another thing, or anywhere."""
        model = self._catalog.draw_big(self._rng)
        ways: tuple[Callable[[Model], Placed | None], ...] = (self._at_wall, self._at_thing, self._anywhere)
        way = ways[int(self._rng.choice(3, p=(0.4, 0.3, 0.3)))]
        for _ in range(_TRIES):
            found = way(model)
            if found is not None:
                self.things.append(found)
                return

    def add_small(self, hosts: list[Placed] | None = None) -> None:
        """One small thing on one of the hosts or in a stack on what stands there; else anywhere, also on the floor."""
        rng = self._rng
        model = self._catalog.draw_small(rng)
        for _ in range(_TRIES):
            place = self._place_on(self._host(hosts))
            if place is None:
                continue
            found = rest(
                model, resting_turns(model, rng, bool(rng.random() < 0.35)), place, [*self.fixed, *self.things]
            )
            if found is not None:
                if rng.random() < 0.4:
                    found = self._moved_to_touch(found, 0.3)
                self.things.append(found)
                return

    def _host(self, hosts: list[Placed] | None) -> Placed | None:
        """What to put a thing on; None for the floor."""
        rng = self._rng
        small = [thing for thing in self.things if thing.model is not None and not thing.model.big]
        if small and rng.random() < 0.18:
            return small[int(rng.integers(len(small)))]
        if hosts is None:
            hosts = [thing for thing in self.things if thing.model is not None and thing.model.big]
            if not hosts or rng.random() < 0.25:
                return None
        return hosts[int(rng.integers(len(hosts)))]

    def _place_on(self, host: Placed | None) -> Array | None:
        rng = self._rng
        if host is not None:
            places = host.upward
            return places[int(rng.integers(len(places)))] if len(places) else None
        beneath = [thing for thing in self.things if thing.model is not None and thing.model.big]
        if beneath and rng.random() < 0.5:  # beneath or beside furniture
            low, high = beneath[int(rng.integers(len(beneath)))].mesh.bounds
            level = rng.uniform(low[:2] - 0.15, high[:2] + 0.15)
        else:
            level = rng.uniform(-self._half, self._half)
        return np.array([*level, 0.0])

    def _at_wall(self, model: Model) -> Placed | None:
        """With one side to a wall, touching it or nearly; sometimes along it into the corner."""
        rng = self._rng
        wall = int(rng.integers(max(self._walls, 1)))
        outward = np.array([(0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, -1.0, 0.0)][wall])
        facing = (0.0, math.pi / 2.0, -math.pi / 2.0, math.pi)[wall]
        turn = turn_about_z(
            facing + float(rng.choice([0.0, 0.0, 0.0, math.pi / 2.0, math.pi])) + rng.normal(scale=0.03)
        )
        found = self._stood(model, turn)
        if found is None:
            return None
        gap = float(rng.choice([GAP_M, rng.uniform(0.002, 0.05)]))
        found = touching(found, outward, [*self.fixed, *self.things], 6.0, gap)
        if rng.random() < 0.25:
            along = np.array([outward[1], outward[0], 0.0]) * rng.choice([-1.0, 1.0])
            found = touching(found, along, [*self.fixed, *self.things], 6.0, gap)
        return found

    def _at_thing(self, model: Model) -> Placed | None:
        """Pushed towards another piece, its front to it: a chair comes to stand at a table, or partly under it."""
        rng = self._rng
        if not self.things:
            return None
        host = self.things[int(rng.integers(len(self.things)))]
        middle, half = host.mesh.bounds.mean(axis=0)[:2], host.mesh.size[:2] / 2.0
        side = int(rng.integers(4))
        outward = np.array([(0.0, 1.0), (1.0, 0.0), (0.0, -1.0), (-1.0, 0.0)][side])
        turn = turn_about_z(math.atan2(outward[1], outward[0]) - math.pi / 2.0 + rng.normal(scale=0.15))
        size = model.mesh.moved(turn).size[:2] / 2.0
        place = middle + outward * (half + size + 0.05) + rng.uniform(-0.35, 0.35) * half * np.abs(outward[::-1])
        if (np.abs(place) + size > self._half).any():
            return None
        found = rest(model, turn, np.array([*place, 0.0]), [*self.fixed, *self.things])
        if found is None:
            return None
        inward = np.array([*-outward, 0.0])
        return touching(
            found, inward, [*self.fixed, *self.things], 0.6, float(rng.choice([GAP_M, rng.uniform(0.01, 0.2)]))
        )

    def _anywhere(self, model: Model) -> Placed | None:
        lying = bool(self._rng.random() < 0.12)
        return self._stood(model, resting_turns(model, self._rng, lying))

    def _stood(self, model: Model, turn: Array) -> Placed | None:
        size = model.mesh.moved(turn).size[:2] / 2.0 + 0.002
        if (size >= self._half).any():
            return None
        place = self._rng.uniform(-self._half + size, self._half - size)
        return rest(model, turn, np.array([*place, 0.0]), [*self.fixed, *self.things])

    def _moved_to_touch(self, thing: Placed, farthest: float) -> Placed:
        angle = self._rng.uniform(0.0, 2.0 * math.pi)
        direction = np.array([math.cos(angle), math.sin(angle), 0.0])
        gap = float(self._rng.choice([GAP_M, self._rng.uniform(0.001, 0.01)]))
        return touching(thing, direction, [*self.fixed, *self.things], farthest, gap)


def _architecture(mesh: Mesh) -> Placed:
    return Placed(None, np.eye(4), mesh)


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
