"""Datasets rendered from meshes: a furnished room, or one object alone in thin air."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from benchmarks.worlds.layouts import Furnishing, Layout
from benchmarks.worlds.mesh_scene import MeshScene, Thing, box_thing, load_thing, tile_paint
from benchmarks.worlds.rendering import DepthSensor, Size, View, intrinsics_of, render
from benchmarks.worlds.trajectories import (
    CLEARANCE_M,
    WalkingGround,
    check_free,
    framing_distance,
    long_walk,
    look_at,
    orbit,
    pass_by,
    short_walk,
)
from regnf_core.errors import DatasetError
from regnf_core.fields.composite import SurfaceSource
from regnf_core.geometry.box import OrientedBox
from regnf_data.posed_images import Instance, PosedImages

Array = NDArray[np.float64]

# One view of one thing, a poor one, chosen by rule.

_AZIMUTHS = 16
_HEIGHTS_M = (0.35, 1.3)
_NEARER = (1.0, 0.8, 0.65)
_SAMPLES = 2000
_MIN_SHOWN = 0.8
_MIN_SEEN = 0.02


def bad_view(scene: MeshScene, thing: Thing, size: Size, intrinsics: Array, floor: float) -> Array:
    """(4, 4): of all views that show the thing, the one that sees the least of its surface.

    Candidates stand in free space at 16 azimuths, 35 cm and 1.3 m above the floor, where the thing just fills the
    picture; nearer only if none of these will do. A view counts as showing the thing when others hide at most a fifth
    of what it would show of it alone. So the camera ends up behind a back or low at a side, the first of equals.
    Raises DatasetError (DATASET_NO_VIEW).
    """
    solid = thing.solid
    assert isinstance(solid, SurfaceSource)
    samples = solid.sample_surface(_SAMPLES, np.random.default_rng(0))
    alone = MeshScene([thing])
    bounds = solid.bounds.numpy()
    for nearer in _NEARER:
        best, least = None, np.inf
        distance = nearer * framing_distance(bounds, half_view(size, intrinsics))
        for pose in _candidates(scene, bounds.mean(axis=0), distance, floor):
            seen = seen_points(scene, pose, size, intrinsics, samples).mean()
            shown = seen_points(alone, pose, size, intrinsics, samples).mean()
            if seen >= max(_MIN_SHOWN * shown, _MIN_SEEN) and seen < least:
                best, least = pose, seen
        if best is not None:
            return best
    raise DatasetError(f"{thing.name} is hidden from everywhere", reason="DATASET_NO_VIEW")


def seen_points(scene: MeshScene, pose: Array, size: Size, intrinsics: Array, points: Array) -> NDArray[np.bool_]:
    """(N,): which surface points (N, 3) a camera at ``pose`` (4, 4) sees: in the picture, and nothing before them."""
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    ahead = local[:, 2] > 0.0
    u, v, _ = intrinsics @ (local / np.where(ahead, local[:, 2], 1.0)[:, None]).T
    inside: NDArray[np.bool_] = ahead & (u >= 0.0) & (u < size[1]) & (v >= 0.0) & (v < size[0])
    inside[inside] = scene.sees(pose[:3, 3], points[inside])
    return inside


def half_view(size: Size, intrinsics: Array) -> float:
    """Half the narrower angle of view, radians."""
    return float(min(np.arctan(size[1] / 2.0 / intrinsics[0, 0]), np.arctan(size[0] / 2.0 / intrinsics[1, 1])))


def _candidates(scene: MeshScene, center: Array, distance: float, floor: float) -> Iterator[Array]:
    low, high = scene.bounds
    alone = len(scene.things) == 1
    for height in _HEIGHTS_M:
        rise = floor + height - center[2]
        level = distance**2 - rise**2
        if level <= 0.0:
            continue
        angles = 2.0 * np.pi * np.arange(_AZIMUTHS) / _AZIMUTHS
        ring = np.sqrt(level) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        positions = center + np.concatenate([ring, np.full((_AZIMUTHS, 1), rise)], axis=1)
        free = scene.signed_distance(positions) >= CLEARANCE_M
        # The far side of a wall is free too, but outside of the room.
        inside = alone | ((positions > low) & (positions < high))[:, :2].all(axis=1)
        yield from look_at(positions[free & inside], np.tile(center, (int((free & inside).sum()), 1)))


Trajectory = Literal["long", "short", "single"]
Progress = Callable[[int, int], None]
"""Told how many images are done, and of how many."""

_FLOOR = tile_paint((0.42, 0.33, 0.22), (0.5, 0.41, 0.29), 0.3)
_WALL = tile_paint((0.62, 0.62, 0.58), (0.7, 0.71, 0.68), 0.4)
_FRAMES = {"room": {"long": 240, "short": 60, "single": 1}, "object": {"long": 60, "short": 20, "single": 1}}
_OBJECT_MARGIN = 0.1
_SINGLE_MARGIN_M = 0.4


@dataclass(frozen=True)
class RenderOptions:
    """How images are taken. frames: None for the usual number · size: height, width · sensor: None for exact depths."""

    trajectory: Trajectory = "long"
    frames: int | None = None
    size: Size = (120, 160)
    field_of_view_deg: float = 60.0
    sensor: DepthSensor | None = field(default_factory=DepthSensor)
    seed: int = 0

    @property
    def intrinsics(self) -> Array:
        """(3, 3)."""
        return intrinsics_of(self.size, self.field_of_view_deg)

    def count(self, kind: str) -> int:
        """How many images of a room or an object. Raises DatasetError (DATASET_FRAMES_INVALID)."""
        usual = _FRAMES[kind][self.trajectory]
        if self.frames is not None and (self.frames < 1 or (usual == 1 and self.frames != 1)):
            raise DatasetError(f"{self.frames} frames: a single view is one", reason="DATASET_FRAMES_INVALID")
        return self.frames or usual


def render_room(
    layout: Layout,
    options: RenderOptions,
    *,
    units_per_meter: float | None = None,
    object_units_per_meter: Mapping[str, float] | None = None,
    instance: str | None = None,
    progress: Progress | None = None,
) -> PosedImages:
    """Images of a furnished room, with every piece's box and true transform.

    units_per_meter: of the world, instead of the layout's · object_units_per_meter: of the library objects that the
    truths lead to, by name, else 1; an object's origin is the middle of its mesh's bounding box · instance: the one
    that a single view shows; then the bounds are its own, with 40 cm round it, and no other instance is listed.
    Raises DatasetError (DATASET_NO_FREE_PATH, DATASET_NO_VIEW, DATASET_NO_INSTANCE, DATASET_FRAMES_INVALID),
    FieldFormatError (MESH_INVALID) and OSError.
    """
    count = options.count("room")
    units = layout.units_per_meter if units_per_meter is None else units_per_meter
    T_world_metric = scale_and_shift(units, layout.origin_m)
    scene = room_scene(layout)
    pieces = list(zip(layout.furnishings, scene.things[-len(layout.furnishings) :], strict=True))
    if options.trajectory == "single":
        pieces = [pair for pair in pieces if pair[0].name == instance][:1]
        if not pieces:
            raise DatasetError(f"{layout.name} has no instance {instance!r}", reason="DATASET_NO_INSTANCE")
        thing = pieces[0][1]
        poses = bad_view(scene, thing, options.size, options.intrinsics, float(layout.floor[1, 2]))[None]
        (lower, upper), (low, high) = thing.solid.bounds.numpy(), scene.bounds
        bounds = np.stack([np.maximum(lower - _SINGLE_MARGIN_M, low), np.minimum(upper + _SINGLE_MARGIN_M, high)])
    else:
        walk = long_walk if options.trajectory == "long" else short_walk
        boxes = [thing.solid.bounds.numpy() for _, thing in pieces]
        poses, bounds = walk(WalkingGround(scene, layout.floor), boxes, count), scene.bounds
    images = _taken(scene, poses, bounds, T_world_metric, options, progress)
    of_object = object_units_per_meter or {}
    instances = [_instance(thing, piece, T_world_metric, of_object.get(piece.name, 1.0)) for piece, thing in pieces]
    return replace(images, instances=tuple(instances), masks=None)


def render_object(
    mesh: str | os.PathLike[str],
    options: RenderOptions,
    *,
    units_per_meter: float = 1.0,
    progress: Progress | None = None,
) -> PosedImages:
    """Images of one mesh alone, with masks; the world is the library object's frame, its origin the mesh's middle.

    Raises DatasetError (DATASET_FRAMES_INVALID, DATASET_NO_VIEW), FieldFormatError (MESH_INVALID) and OSError.
    """
    count = options.count("object")
    name = Path(mesh).stem
    thing = load_thing(mesh, name=name)
    scene = MeshScene([thing])
    bounds = thing.solid.bounds.numpy()
    floor = float(bounds[0, 2])
    if options.trajectory == "single":
        poses = bad_view(scene, thing, options.size, options.intrinsics, floor)[None]
    else:
        circle = orbit if options.trajectory == "long" else pass_by
        poses = circle(bounds, count, half_view(options.size, options.intrinsics), floor)
    margin = _OBJECT_MARGIN * float((bounds[1] - bounds[0]).max())
    T_world_metric = scale_and_shift(units_per_meter, bounds.mean(axis=0))
    images = _taken(scene, poses, bounds + np.array([[-margin], [margin]]), T_world_metric, options, progress)
    whole = Furnishing(name, Path(mesh), np.eye(4), None)
    return replace(images, instances=(_instance(thing, whole, T_world_metric, units_per_meter),))


def room_scene(layout: Layout) -> MeshScene:
    """Floor, walls and furniture. Walls reach down through the floor, so that no gap or face lies between them."""
    bottom = layout.floor[0, 2]
    walls = [box_thing([*wall[0, :2], min(bottom, wall[0, 2])], wall[1], _WALL) for wall in layout.walls]
    pieces = [load_thing(piece.mesh, piece.T_room_mesh, piece.name) for piece in layout.furnishings]
    return MeshScene([box_thing(layout.floor[0], layout.floor[1], _FLOOR), *walls, *pieces])


def scale_and_shift(units_per_meter: float, origin_m: tuple[float, float, float] | Array) -> Array:
    """(4, 4): meters less ``origin_m``, times ``units_per_meter``."""
    if not 0.0 < units_per_meter < math.inf:
        raise DatasetError("units per meter must be positive", reason="DATASET_SCALE_INVALID")
    matrix = np.diag([units_per_meter] * 3 + [1.0])
    matrix[:3, 3] = -units_per_meter * np.asarray(origin_m)
    return matrix


def _taken(
    scene: MeshScene,
    poses: Array,
    bounds: Array,
    T_world_metric: Array,
    options: RenderOptions,
    progress: Progress | None,
) -> PosedImages:
    """Images from metric poses, put into the world frame."""
    check_free(scene, poses)
    rng, sensor = np.random.default_rng(options.seed), options.sensor
    views: list[View] = []
    depths = []
    for pose in poses:
        view = render(scene, options.size, options.intrinsics, pose)
        depth = view.depth if sensor is None else sensor.measure(view.depth, view.cosine, rng)
        views.append(view)
        depths.append((depth * float(T_world_metric[0, 0])).astype(np.float32))
        if progress is not None:
            progress(len(views), len(poses))
    T_world_camera = poses.copy()
    T_world_camera[:, :3, 3] = poses[:, :3, 3] @ T_world_metric[:3, :3].T + T_world_metric[:3, 3]
    return PosedImages(
        colors=np.stack([view.colors for view in views]),
        intrinsics=np.tile(options.intrinsics, (len(poses), 1, 1)),
        T_world_camera=T_world_camera,
        bounds=bounds @ T_world_metric[:3, :3].T + T_world_metric[:3, 3],
        depths=np.stack(depths),
        masks=np.stack([view.thing >= 0 for view in views]),
        T_metric_world=np.asarray(np.linalg.inv(T_world_metric), dtype=np.float64),
    )


def _instance(thing: Thing, piece: Furnishing, T_world_metric: Array, object_units: float) -> Instance:
    """The stated bounds if there are any: detections elsewhere are made of them."""
    metric = thing.solid.bounds.numpy() if piece.bounds is None else piece.bounds
    lower, upper = metric @ T_world_metric[:3, :3].T + T_world_metric[:3, 3]
    mesh_bounds = load_thing(piece.mesh).solid.bounds.numpy()
    T_world_mesh = T_world_metric @ piece.T_room_mesh
    return Instance(
        piece.name,
        OrientedBox.from_corners(lower.tolist(), upper.tolist(), piece.name),
        T_object_world=scale_and_shift(object_units, mesh_bounds.mean(axis=0)) @ np.linalg.inv(T_world_mesh),
        world_pose=T_world_mesh,
        gt_pose=piece.T_room_mesh,
    )
