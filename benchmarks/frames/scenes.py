"""Frames of an object among others on a table, a floor or a shelf, with detections as detectors make them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import ConvexHull, cKDTree

from benchmarks.frames.sensors import KINDS, Kind, Surfaces, measure
from benchmarks.random_worlds.mesh import Array, Mesh, box, ray_scene, standing
from benchmarks.random_worlds.models import Model, Part, families, parametric_small, part_of
from benchmarks.random_worlds.symmetries import measure_symmetries
from benchmarks.symmetric_errors import Symmetries
from benchmarks.worlds.rendering import camera_rays
from benchmarks.worlds.trajectories import look_at
from regnf_core.detections.images import ImageDetection
from regnf_core.fields.observation import SdfField
from regnf_core.importing.mesh_file import load_solid
from regnf_core.in_memory import from_mesh
from regnf_core.robust.model import ObjectModel, model_object
from regnf_data.recordings.camera import Camera
from regnf_data.recordings.recording import Frame

Mask = NDArray[np.bool_]
SIZE = (480, 640)
_SMALL_M, _LARGEST_M = 0.42, 2.4
"""Things up to the first stand on tables; between both they are furniture."""
_INVENTED = 60
"""Parametric things that the part train has besides the meshes of files."""
_MOST_FACES = 4000
_FEWEST_PIXELS = 70
"""Across an object: cameras come nearer to smaller ones."""


@dataclass(frozen=True, eq=False)
class Known:
    """An object, standing, in the unit of its file. size: its longest side there."""

    name: str
    mesh: Mesh

    @property
    def size(self) -> float:
        return float(self.mesh.size.max())

    @cached_property
    def field(self) -> SdfField:
        return from_mesh(self.mesh.vertices, self.mesh.faces)

    @cached_property
    def model(self) -> ObjectModel:
        return model_object(self.field)

    @cached_property
    def surface(self) -> Model:
        return Model(self.name, self.mesh)

    @cached_property
    def symmetries(self) -> tuple[Symmetries, Symmetries]:
        """Those within 1 % of the diameter, and those within 3 %."""
        exact, near = measure_symmetries(self.surface)
        return Symmetries.from_dict(exact), Symmetries.from_dict(near)


@dataclass(frozen=True, eq=False)
class Library:
    """The objects of a part: small ones and furniture."""

    small: tuple[Known, ...]
    big: tuple[Known, ...]


@cache
def library(folders: tuple[Path, ...], part: Part) -> Library:
    """The meshes in the folders that belong to a part, by a hash of their family's name."""
    paths = [path for folder in folders for path in sorted(folder.glob("*.glb"))]
    family = families(path.stem for path in paths)
    known = [_read(path) for path in paths if part_of(family[path.stem]) == part]
    big = tuple(one for one in known if _SMALL_M < one.size <= _LARGEST_M)
    small = [one for one in known if one.size <= _SMALL_M]
    if part == "train":
        for seed in range(_INVENTED):
            made = parametric_small(np.random.default_rng(seed))
            small.append(Known(f"{made.name}_{seed}", made.mesh))
    return Library(tuple(small), big)


def _read(path: Path) -> Known:
    import open3d

    field, _ = load_solid(path, "object")
    mesh = open3d.geometry.TriangleMesh(
        *(
            o3(part)
            for o3, part in (
                (open3d.utility.Vector3dVector, field.vertices),
                (open3d.utility.Vector3iVector, field.faces),
            )
        )
    )
    if len(field.faces) > _MOST_FACES:  # the time of a registration grows with them
        mesh = mesh.merge_close_vertices(1e-6).simplify_quadric_decimation(_MOST_FACES)
    return Known(path.stem, standing(Mesh(np.asarray(mesh.vertices), np.asarray(mesh.triangles).astype(np.int64))))


@dataclass(frozen=True, eq=False)
class Placed:
    """An object in the world. T: (4, 4), a similarity from its file's frame · dark, bare: what its surface is like."""

    known: Known
    T: Array
    dark: bool
    bare: bool

    @cached_property
    def mesh(self) -> Mesh:
        return Mesh(_carried(self.T, self.known.mesh.vertices), self.known.mesh.faces)

    @cached_property
    def points(self) -> Array:
        return self.mesh.sample(600, np.random.default_rng(0))[0]


@dataclass(frozen=True, eq=False)
class View:
    """One image. frame: as the sensor read it, with its stated pose · things: (H, W) number of the thing seen: 0 is the
    object, -1 background."""

    frame: Frame
    things: NDArray[np.int64]

    @property
    def mask(self) -> Mask:
        return np.asarray(self.things == 0)


@dataclass(frozen=True, eq=False)
class Simulated:
    """Frames of one object. scale: meters for each unit of its file · visible: share of its silhouette in the first
    frame · placed: the object and the things around it."""

    placed: tuple[Placed, ...]
    scale: float
    views: tuple[View, ...]
    visible: float
    facts: dict[str, Any]


def _carried(T: Array, points: Array) -> Array:
    moved: Array = points @ T[:3, :3].T + T[:3, 3]
    return moved


def simulate(folders: tuple[Path, ...], part: Part, seed: int) -> Simulated:
    """The frames of a seed: the same for every call."""
    rng = np.random.default_rng([seed, ("train", "validation", "test").index(part)])
    known = library(folders, part)
    furniture = rng.random() < 0.2
    target = known.big[rng.integers(len(known.big))] if furniture else _small(known, rng)
    longest = target.size if furniture else _longest(target, rng)
    scale = longest / target.size
    placed = [_put(target, scale, np.zeros(2), rng, lying=0.0 if furniture else 0.3)]
    place = "floor" if furniture else str(rng.choice(["table", "table", "floor", "shelf"]))
    direction, distance = _viewpoint(place, longest, furniture, rng)
    for _ in range(int(rng.integers(0, 4))):
        placed.append(_beside(placed[0], _clutter(known, longest, furniture, rng), rng.uniform(0, 2 * math.pi), rng))
    rooms = _room(place, placed[0], rng)
    wanted = float(
        rng.choice([rng.uniform(0.5, 1.0), rng.uniform(0.2, 0.5), rng.uniform(0.1, 0.2)], p=[0.6, 0.36, 0.04])
    )
    if rng.random() < 0.25:
        wanted = 1.0
    middle = placed[0].mesh.bounds.mean(axis=0)
    pose = _pose(middle, direction, distance, rng)
    focal = rng.uniform(540.0, 640.0)
    K = np.array(
        [[focal, 0.0, 320.0 + rng.normal(scale=5.0)], [0.0, focal, 240.0 + rng.normal(scale=5.0)], [0, 0, 1.0]]
    )
    placed = _hidden(placed, known, rooms, wanted, (K, pose), longest, furniture, rng)
    kind: Kind = KINDS[rng.integers(len(KINDS))]
    count = int(rng.integers(2, 6)) if rng.random() < 0.25 else 1
    poses = [pose] + [
        _pose(middle, _turned(direction, place, rng), distance * rng.uniform(0.8, 1.25), rng) for _ in range(count - 1)
    ]
    meshes = [one.mesh for one in placed] + rooms
    scene = ray_scene(meshes)
    drift = 0.0 if count == 1 else float(rng.uniform(0.0, 1.0))
    views = []
    visible = 0.0
    for number, T in enumerate(poses):
        exact, cosine, things = _cast(scene, K, T)
        if number == 0:
            alone = _cast(ray_scene([placed[0].mesh]), K, T)[2] == 0
            visible = float((things == 0).sum() / max(alone.sum(), 1))
        dark, bare = (
            np.array([*(getattr(one, which) for one in placed), *(False for _ in rooms), False])
            for which in ("dark", "bare")
        )
        bare[len(placed) : -1] = rng.random(len(rooms)) < 0.3
        depth = measure(kind, exact, cosine, Surfaces(dark[things], bare[things]), focal, rng)
        stated = T if number == 0 else _drifted(T, drift, rng)
        things = np.where(things < len(placed), things, -1)
        views.append(View(Frame(str(number), depth, Camera(K, SIZE), stated), things))
    facts = {
        "part": part, "seed": seed, "object": target.name, "furniture": furniture, "sensor": kind,
        "place": place, "views": count,
        "visible": round(visible, 4), "longest_m": round(longest, 4), "distance_m": round(float(distance), 3),
        "pixels": int((views[0].things == 0).sum()),
    }  # fmt: skip
    return Simulated(tuple(placed), scale, tuple(views), visible, facts)


def _small(known: Library, rng: np.random.Generator) -> Known:
    """Small things, at times furniture as a toy."""
    if rng.random() < 0.08 and known.big:
        return known.big[rng.integers(len(known.big))]
    return known.small[rng.integers(len(known.small))]


def _longest(target: Known, rng: np.random.Generator) -> float:
    """Meters: near the file's own, or between 3 and 40 cm."""
    if target.size <= _SMALL_M and rng.random() < 0.6:
        return float(np.clip(target.size * rng.uniform(0.8, 1.25), 0.03, 0.4))
    return float(np.exp(rng.uniform(math.log(0.04), math.log(0.4))))


def _clutter(known: Library, longest: float, furniture: bool, rng: np.random.Generator) -> tuple[Known, float]:
    """A thing and its scale, about as large as the object."""
    one = known.big[rng.integers(len(known.big))] if furniture else _small(known, rng)
    size = float(np.clip(one.size, 0.5 * longest, 1.6 * longest)) * rng.uniform(0.8, 1.2)
    return one, size / one.size


def _put(known: Known, scale: float, at: Array, rng: np.random.Generator, lying: float = 0.25) -> Placed:
    """Standing at a place (2,), turned at random about the vertical; or on one of its other faces."""
    R = np.eye(3)
    if rng.random() < lying:
        hull = ConvexHull(known.mesh.vertices)
        face = rng.choice(len(hull.equations), p=hull_areas(known.mesh.vertices, hull))
        R = _rotation_to(hull.equations[face, :3], np.array([0.0, 0.0, -1.0]))
    angle = rng.uniform(0.0, 2.0 * math.pi)
    turn = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1.0]])
    T = np.eye(4)
    T[:3, :3] = scale * turn @ R
    moved = _carried(T, known.mesh.vertices)
    low, high = moved.min(axis=0), moved.max(axis=0)
    T[:3, 3] = [at[0] - (low[0] + high[0]) / 2.0, at[1] - (low[1] + high[1]) / 2.0, -low[2]]
    return Placed(known, T, bool(rng.random() < 0.15), bool(rng.random() < 0.35))


def hull_areas(vertices: Array, hull: ConvexHull) -> Array:
    """(F,): shares of the hull's area."""
    a, b, c = (vertices[hull.simplices[:, i]] for i in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    shares: Array = areas / areas.sum()
    return shares


def _rotation_to(start: Array, end: Array) -> Array:
    axis, cosine = np.cross(start, end), float(start @ end)
    if cosine < -0.9999:
        return np.diag([1.0, -1.0, -1.0])
    S = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turned: Array = np.eye(3) + S + S @ S / (1.0 + cosine)
    return turned


def _moved(one: Placed, by: Array) -> Placed:
    T = one.T.copy()
    T[:2, 3] += by
    return Placed(one.known, T, one.dark, one.bare)


def _beside(
    target: Placed, thing: tuple[Known, float], angle: float, rng: np.random.Generator, gap: float | None = None
) -> Placed:
    """The thing pushed towards the target until it nearly touches it."""
    one = _put(*thing, np.zeros(2), rng)
    direction = np.array([math.cos(angle), math.sin(angle)])
    tree = cKDTree(target.points)
    reach = float(np.linalg.norm(target.mesh.size[:2]) + np.linalg.norm(one.mesh.size[:2]))
    gap = gap if gap is not None else rng.choice([0.002, rng.uniform(0.002, 0.05)]) + 0.02 * reach
    low, high = 0.0, reach
    for _ in range(9):
        middle = (low + high) / 2.0
        near = tree.query(one.points + middle * np.append(direction, 0.0))[0].min() < gap
        inside = middle < 0.3 * reach / 2.0
        low, high = (middle, high) if near or inside else (low, middle)
    return _moved(one, high * direction)


def _viewpoint(place: str, longest: float, furniture: bool, rng: np.random.Generator) -> tuple[Array, float]:
    azimuth = rng.uniform(0.0, 2.0 * math.pi)
    elevation = math.radians(rng.uniform(15.0, 65.0))
    if place == "shelf":
        azimuth, elevation = -math.pi / 2.0 + rng.uniform(-0.8, 0.8), math.radians(rng.uniform(0.0, 30.0))
    if furniture:
        elevation = math.radians(rng.uniform(8.0, 40.0))
        distance = rng.uniform(max(1.5, 1.1 * longest), 4.0)
    else:
        distance = rng.uniform(max(0.4, 1.3 * longest), max(min(1.5, longest * 590.0 / _FEWEST_PIXELS), 0.42))
    return _direction(azimuth, elevation), float(distance)


def _direction(azimuth: float, elevation: float) -> Array:
    return np.array(
        [math.cos(azimuth) * math.cos(elevation), math.sin(azimuth) * math.cos(elevation), math.sin(elevation)]
    )


def _turned(direction: Array, place: str, rng: np.random.Generator) -> Array:
    azimuth = math.atan2(direction[1], direction[0])
    elevation = math.asin(direction[2])
    spread = 0.5 if place == "shelf" or rng.random() < 0.5 else 1.5
    return _direction(
        azimuth + rng.uniform(-spread, spread), float(np.clip(elevation + rng.normal(scale=0.15), 0.0, 1.2))
    )


def _pose(middle: Array, direction: Array, distance: float, rng: np.random.Generator) -> Array:
    target = middle + 0.08 * distance * rng.normal(size=3)
    return np.asarray(look_at((middle + distance * direction)[None], target[None])[0])


def _drifted(T: Array, drift: float, rng: np.random.Generator) -> Array:
    """A stated pose: off by up to 5 mm and half a degree."""
    axis = rng.normal(size=3)
    angle = drift * math.radians(0.5) * rng.random()
    w = axis / np.linalg.norm(axis) * angle
    S = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    shift = rng.normal(size=3)
    out = T.copy()
    out[:3, :3] = (np.eye(3) + S + S @ S / 2.0) @ T[:3, :3]
    out[:3, :3] = np.linalg.qr(out[:3, :3])[0] * np.sign(np.diag(np.linalg.qr(out[:3, :3])[1]))
    out[:3, 3] += 0.005 * drift * rng.random() * shift / np.linalg.norm(shift)
    return out


def _room(place: str, target: Placed, rng: np.random.Generator) -> list[Mesh]:
    """What the object stands on, and walls."""
    width, depth, height = target.mesh.size
    walls = [box((-4, -4, -0.85), (4, 4, -0.8)), box((-4, 2.5, -1), (4, 2.6, 3)), box((-4, -2.6, -1), (4, -2.5, 3))]
    if place == "floor":
        near = max(width, depth) / 2.0 + rng.uniform(0.02, 1.0)
        return [box((-4, -4, -0.05), (4, 4, 0.0)), box((-4, near + 0.3, 0), (4, near + 0.4, 3))][
            : int(rng.integers(1, 3))
        ]
    edge = max(width, depth) / 2.0 + rng.uniform(0.02, 0.4, 4)
    if place == "table":
        return [box((-edge[0] - 0.3, -edge[1] - 0.3, -0.03), (edge[2] + 0.3, edge[3] + 0.3, 0.0)), *walls]
    above, side = height * rng.uniform(1.1, 1.8), width / 2.0 + rng.uniform(0.03, 0.4)
    back = depth / 2.0 + rng.uniform(0.0, 0.2)
    front = depth / 2.0 + rng.uniform(0.0, 0.1)
    boards = [
        box((-side - 0.5, -front, -0.02), (side + 0.5, back, 0.0)),
        box((-side - 0.5, -front, above), (side + 0.5, back, above + 0.02)),
    ]
    return [
        *boards,
        box((-side - 0.5, back, -0.5), (side + 0.5, back + 0.02, above + 0.5)),
        box((side, -front, 0), (side + 0.02, back, above)),
        *walls,
    ]


def _hidden(
    placed: list[Placed],
    known: Library,
    rooms: list[Mesh],
    wanted: float,
    seen: tuple[Array, Array],
    longest: float,
    furniture: bool,
    rng: np.random.Generator,
) -> list[Placed]:
    """With one or two things more, before the object, so that about the ``wanted`` share of it is visible."""
    K, pose = seen
    coarse = K.copy()
    coarse[:2] /= 5.0
    alone = int((_cast(ray_scene([placed[0].mesh]), coarse, pose, (96, 128))[2] == 0).sum())

    def share(things: list[Placed]) -> float:
        found = _cast(ray_scene([*(one.mesh for one in things), *rooms]), coarse, pose, (96, 128))[2]
        return float((found == 0).sum()) / max(alone, 1)

    best, off = placed, abs(share(placed) - wanted)
    towards = math.atan2(pose[1, 3], pose[0, 3])
    for attempt in range(10):
        if off < 0.08 or share(placed) < wanted:
            break
        start = best if attempt % 3 == 2 else placed
        more = _beside(placed[0], _clutter(known, longest, furniture, rng), towards + rng.normal(scale=0.6), rng)
        if np.linalg.norm(more.mesh.bounds.mean(axis=0) - pose[:3, 3]) < 0.25:
            continue
        found = abs(share([*start, more]) - wanted)
        if found < off:
            best, off = [*start, more], found
    return best


def _cast(scene: Any, K: Array, T: Array, size: tuple[int, int] = SIZE) -> tuple[Array, Array, NDArray[np.int64]]:
    """Depth (H, W), 0 for nothing, cosine of ray and normal, and number of the mesh, -1 for none."""
    import open3d

    origins, directions = camera_rays(size, K, T)
    rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
    answer = scene.cast_rays(open3d.core.Tensor.from_numpy(rays))
    depth = answer["t_hit"].numpy().astype(np.float64).reshape(size)
    normal = answer["primitive_normals"].numpy()
    cosine = np.abs((normal * directions).sum(axis=1)) / np.linalg.norm(directions, axis=1)
    hit = np.isfinite(depth)
    things = np.where(hit, answer["geometry_ids"].numpy().astype(np.int64).reshape(size), -1)
    return np.where(hit, depth, 0.0), cosine.reshape(size), things


# Detections.


def _grown(mask: Mask, pixels: int) -> Mask:
    """Grown by so many pixels, shrunk by a negative number, as far as something is left."""
    ball = np.hypot(*np.mgrid[-abs(pixels) : abs(pixels) + 1, -abs(pixels) : abs(pixels) + 1]) <= abs(pixels) + 0.3
    if pixels > 0:
        return np.asarray(ndimage.binary_dilation(mask, ball))
    less = np.asarray(ndimage.binary_erosion(mask, ball))
    return less if less.sum() > 0.25 * mask.sum() else mask


def _shifted(mask: Mask, pixels: int, rng: np.random.Generator) -> Mask:
    angle = rng.uniform(0.0, 2.0 * math.pi)
    return np.roll(mask, (round(pixels * math.sin(angle)), round(pixels * math.cos(angle))), axis=(0, 1))


def _with_neighbor(mask: Mask, things: NDArray[np.int64]) -> Mask:
    """With the part of another thing, or of the background, that lies nearest: a fifth more pixels."""
    apart = ndimage.distance_transform_edt(~mask)
    others = (things > 0) & (apart < 40)
    pool = others if others.any() else ~mask
    limit = np.sort(apart[pool])[min(int(0.2 * mask.sum()), int(pool.sum()) - 1)]
    return mask | (pool & (apart <= limit))


def _ragged(mask: Mask, rng: np.random.Generator) -> Mask:
    signed = ndimage.distance_transform_edt(mask) - ndimage.distance_transform_edt(~mask)
    wave = ndimage.zoom(rng.normal(size=(24, 32)), 20, order=1)
    found = signed + 3.0 * wave > 0.0
    return np.asarray(found) if found.sum() > 30 else mask


def _boxed(mask: Mask, loose: float) -> tuple[float, float, float, float]:
    rows, columns = np.nonzero(mask)
    low, high = np.array([columns.min(), rows.min()]), np.array([columns.max(), rows.max()]) + 1.0
    more = loose * (high - low) / 2.0
    (left, top), (right, bottom) = np.maximum(low - more, 0.0), np.minimum(high + more, [SIZE[1], SIZE[0]])
    return float(left), float(top), float(right), float(bottom)


def _clicked(mask: Mask) -> tuple[float, float]:
    depth = ndimage.distance_transform_edt(mask)
    row, column = np.unravel_index(int(depth.argmax()), mask.shape)
    return float(column) + 0.5, float(row) + 0.5


Detected = Callable[[View, np.random.Generator], dict[str, Any]]
DETECTIONS: dict[str, tuple[float, Detected]] = {
    "mask": (0.26, lambda view, rng: {"mask": view.mask}),
    "mask +3": (0.08, lambda view, rng: {"mask": _grown(view.mask, 3)}),
    "mask -3": (0.08, lambda view, rng: {"mask": _grown(view.mask, -3)}),
    "mask +6": (0.06, lambda view, rng: {"mask": _grown(view.mask, 6)}),
    "mask -6": (0.06, lambda view, rng: {"mask": _grown(view.mask, -6)}),
    "mask shifted 3": (0.06, lambda view, rng: {"mask": _shifted(view.mask, 3, rng)}),
    "mask shifted 6": (0.04, lambda view, rng: {"mask": _shifted(view.mask, 6, rng)}),
    "mask with a neighbor": (0.06, lambda view, rng: {"mask": _with_neighbor(view.mask, view.things)}),
    "mask ragged": (0.05, lambda view, rng: {"mask": _ragged(view.mask, rng)}),
    "box 0": (0.05, lambda view, rng: {"box_2d": _boxed(view.mask, 0.0)}),
    "box 10": (0.05, lambda view, rng: {"box_2d": _boxed(view.mask, 0.1)}),
    "box 20": (0.05, lambda view, rng: {"box_2d": _boxed(view.mask, 0.2)}),
    "box 30": (0.05, lambda view, rng: {"box_2d": _boxed(view.mask, 0.3)}),
    "click": (0.05, lambda view, rng: {"point_2d": _clicked(view.mask)}),
}
"""What detectors say of a thing, by name: how often, and how."""


def detection(view: View, name: str, rng: np.random.Generator) -> ImageDetection:
    """What a detector of this name says of the object in the view."""
    return ImageDetection(frame=view.frame.name, **DETECTIONS[name][1](view, rng))


def draw_detection(rng: np.random.Generator) -> str:
    """A name of DETECTIONS."""
    names = list(DETECTIONS)
    shares = np.array([DETECTIONS[name][0] for name in names])
    return str(rng.choice(names, p=shares / shares.sum()))
