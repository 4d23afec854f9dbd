"""What worlds are furnished with: meshes from files and parametric furniture, big things and small ones."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import count
from pathlib import Path
from typing import Literal

import numpy as np

from benchmarks.random_worlds import tables
from benchmarks.random_worlds.mesh import Array, Mesh, ball, beam, block, box, disc, rod, standing, together, tube
from benchmarks.random_worlds.small_things import SMALL
from regnf_core.errors import DatasetError
from regnf_core.importing.mesh_file import load_solid

# Chairs, stools and sofas drawn at random. Meters, z up; the sitter looks along -y.

_BACKS = ("slats", "rails", "panel", "cross", "frame", "curved")
_LEGS = ("square", "round", "splayed", "star", "sled", "cantilever", "panels")


def chair(rng: np.random.Generator) -> Mesh:
    """A seat with a back, on legs of some style, perhaps with arms."""
    width, depth = rng.uniform(0.36, 0.56), rng.uniform(0.36, 0.52)
    height, thick = rng.uniform(0.4, 0.5), rng.uniform(0.012, 0.09)
    legs = str(rng.choice(_LEGS))
    parts = [_seat(rng, width, depth, height, thick), *_legs(rng, legs, width, depth, height - thick / 2.0)]
    parts += _back(rng, str(rng.choice(_BACKS)), width, depth, height)
    if rng.random() < 0.35:
        parts += _arms(rng, width, depth, height)
    if legs in ("square", "round") and rng.random() < 0.5:
        parts += _stretchers(rng, width, depth, height)
    return together(*parts)


def stool(rng: np.random.Generator) -> Mesh:
    """A seat on legs, low or as high as a bar."""
    radius, height, thick = rng.uniform(0.15, 0.24), rng.uniform(0.4, 0.78), rng.uniform(0.02, 0.07)
    count = int(rng.integers(3, 5))
    spread, leg = rng.uniform(0.8, 1.35), rng.uniform(0.012, 0.024)
    if rng.random() < 0.5:
        seat = disc((0.0, 0.0, height - thick), (radius, radius), thick)
    else:
        seat = block((0.0, 0.0, height - thick / 2.0), (2.0 * radius, rng.uniform(1.2, 2.0) * radius, thick))
    parts, feet = [seat], []
    for angle in (2.0 * math.pi * (k + 0.5) / count for k in range(count)):
        top = 0.75 * radius * np.array([math.cos(angle), math.sin(angle)])
        feet.append((spread * top * 1.1, top))
        parts.append(rod((*feet[-1][0], 0.0), (*top, height - thick / 2.0), leg))
    if rng.random() < 0.6:
        at = rng.uniform(0.25, 0.5)
        ring = [(*(foot + at * (top - foot)), at * (height - thick / 2.0)) for foot, top in feet]
        parts.append(tube([*ring, ring[0]], 0.7 * leg))
    return together(*parts)


def sofa(rng: np.random.Generator) -> Mesh:
    """An armchair or a sofa for two, with cushions, on feet."""
    width, depth = rng.uniform(0.7, 1.9), rng.uniform(0.7, 0.95)
    seat, back, arm = rng.uniform(0.36, 0.46), rng.uniform(0.65, 0.95), rng.uniform(0.08, 0.2)
    foot = rng.uniform(0.03, 0.15)
    x, y = width / 2.0, depth / 2.0
    rear = rng.uniform(0.12, 0.25)
    parts = [
        box((-x, -y, foot), (x, y, seat - 0.12)),
        box((-x, y - rear, foot), (x, y, back)),
        *(box((s * x - (s > 0) * arm, -y, foot), (s * x + (s < 0) * arm, y, seat + 0.2)) for s in (-1, 1)),
    ]
    count = max(1, round((width - 2.0 * arm) / 0.6))
    edge = (width - 2.0 * arm) / count
    for k in range(count):
        left = -x + arm + k * edge
        bulge = rng.uniform(0.0, 0.03)
        parts.append(box((left + 0.008, -y - bulge, seat - 0.14), (left + edge - 0.008, y - rear, seat + bulge)))
        if rng.random() < 0.7:
            lean = (left + edge / 2.0, y - rear - 0.05, seat - 0.02)
            parts.append(beam(lean, (lean[0], y - rear + 0.05, back - 0.02 + 2.0 * bulge), edge - 0.04, 0.14))
    parts += [block((i * (x - 0.06), j * (y - 0.06), foot / 2.0 + 0.005), (0.05, 0.05, foot + 0.01)) for i, j in _SIGNS]
    return together(*parts)


_SIGNS = ((-1, -1), (-1, 1), (1, -1), (1, 1))


def _seat(rng: np.random.Generator, width: float, depth: float, height: float, thick: float) -> Mesh:
    if rng.random() < 0.2:
        return disc((0.0, 0.0, height - thick), (width / 2.0, depth / 2.0), thick)
    slab = block((0.0, 0.0, height - thick / 2.0), (width, depth, thick))
    if rng.random() < 0.3:  # a cushion
        soft = rng.uniform(0.02, 0.06)
        return together(slab, block((0.0, 0.0, height + soft / 2.0 - 0.004), (0.92 * width, 0.92 * depth, soft)))
    return slab


def _legs(rng: np.random.Generator, style: str, width: float, depth: float, height: float) -> list[Mesh]:
    x, y = width / 2.0 - 0.03, depth / 2.0 - 0.03
    if style == "star":
        return _star_base(rng, height)
    if style == "panels":
        thick = rng.uniform(0.015, 0.03)
        return [block((s * x, 0.0, height / 2.0), (thick, 2.0 * y, height)) for s in (-1, 1)]
    if style in ("sled", "cantilever"):
        radius, front = rng.uniform(0.009, 0.015), -y
        sides = []
        for s in (-1.0, 1.0):
            down = [(s * x, front, height), (s * x, front, radius), (s * x, y, radius)]
            sides.append(tube([*down, (s * x, y, height)] if style == "sled" else down, radius))
        across = rod((-x, y, radius), (x, y, radius), radius)
        return [*sides, across, rod((-x, front, height - radius), (x, front, height - radius), radius)]
    thick = rng.uniform(0.02, 0.05)
    if style == "square":
        taper = rng.uniform(0.6, 1.0)
        return [beam((i * x, j * y, 0.0), (i * x, j * y, height), thick * taper, thick) for i, j in _SIGNS]
    out = rng.uniform(1.05, 1.3) if style == "splayed" else 1.0
    top, end = thick / 2.0, thick / 2.0 * rng.uniform(0.5, 1.0)
    return [rod((i * x * out, j * y * out, 0.0), (i * x, j * y, height), end, top) for i, j in _SIGNS]


def _star_base(rng: np.random.Generator, height: float) -> list[Mesh]:
    """A column on spokes, each on a caster or a foot."""
    count, reach = int(rng.integers(4, 6)), rng.uniform(0.25, 0.34)
    wheel = rng.uniform(0.02, 0.03)
    hub = 2.0 * wheel + 0.03
    parts = [rod((0.0, 0.0, hub - 0.01), (0.0, 0.0, height), rng.uniform(0.02, 0.035))]
    for k in range(count):
        angle = 2.0 * math.pi * k / count + math.pi / 2.0
        tip = (reach * math.cos(angle), reach * math.sin(angle))
        parts.append(beam((0.0, 0.0, hub), (*tip, 2.0 * wheel + 0.005), 0.045, 0.025))
        parts.append(ball((*tip, wheel), wheel, 10))
        parts.append(rod((*tip, wheel), (*tip, 2.0 * wheel + 0.005), 0.008, sides=8))
    return parts


def _back(rng: np.random.Generator, style: str, width: float, depth: float, height: float) -> list[Mesh]:
    top, lean = height + rng.uniform(0.28, 0.58), rng.uniform(0.0, 0.12)
    x, y, post = width / 2.0 - 0.02, depth / 2.0 - 0.02, rng.uniform(0.015, 0.035)
    low = height - 0.02

    def at(side: float, share: float) -> tuple[float, float, float]:
        return side * x, y + share * lean, low + share * (top - low)

    posts = [beam(at(s, 0.0), at(s, 1.0), post, post) for s in (-1.0, 1.0)]
    if style == "panel":
        start = rng.uniform(0.05, 0.35)
        return [*posts, beam(at(0.0, start), at(0.0, 1.0), 2.0 * x, rng.uniform(0.01, 0.04))]
    if style == "curved":
        return _curved_back(rng, x, y, (low, top), lean)
    rail = rng.uniform(0.03, 0.09)
    rails = [beam(at(-1.0, 0.96), at(1.0, 0.96), 0.02, rail)]
    if style == "slats":
        count = int(rng.integers(2, 8))
        rails.append(beam(at(-1.0, 0.15), at(1.0, 0.15), 0.02, 0.03))
        slim = rng.uniform(0.008, 0.03)
        sides = np.linspace(-1.0, 1.0, count + 2)[1:-1]
        return [*posts, *rails, *(beam(at(s, 0.15), at(s, 0.96), slim, 0.012) for s in sides.tolist())]
    if style == "rails":
        levels = np.linspace(0.3, 0.96, int(rng.integers(2, 5)))
        return [*posts, *(beam(at(-1.0, v), at(1.0, v), 0.018, rail) for v in levels.tolist())]
    if style == "cross":
        diagonals = [beam(at(-s, 0.12), at(s, 0.96), 0.018, 0.02) for s in (-1.0, 1.0)]
        return [*posts, *rails, *diagonals]
    return [*posts, *rails, beam(at(-1.0, 0.5), at(1.0, 0.5), 0.02, 0.02)]


def _curved_back(rng: np.random.Generator, x: float, y: float, heights: tuple[float, float], lean: float) -> list[Mesh]:
    """Upright boards along an arc round the seat's rear."""
    low, top = heights
    bend, count = rng.uniform(0.5, 1.1), int(rng.integers(5, 10))
    angles = np.linspace(-bend, bend, count)
    radius = x / math.sin(bend)
    wide = 1.15 * 2.0 * radius * math.sin(bend / (count - 1))
    start = low if rng.random() < 0.5 else low + 0.3 * (top - low)
    boards = []
    for a in angles.tolist():
        place = np.array([radius * math.sin(a), y - radius + radius * math.cos(a)])
        out = lean * np.array([math.sin(a), math.cos(a)])
        board = block((0.0, 0.0, (start + top) / 2.0), (wide, 0.018, top - start))
        turn = np.eye(4)
        turn[:2, :2] = [[math.cos(a), math.sin(a)], [-math.sin(a), math.cos(a)]]
        turn[:2, 2] = out / (top - low)
        turn[:2, 3] = place - turn[:2, 2] * low
        boards.append(board.moved(turn))
    stems = [
        rod((s * 0.6 * x, y - 0.03, low - 0.01), (s * 0.6 * x, y + 0.3 * lean, start + 0.08), 0.012) for s in (-1, 1)
    ]
    return [*boards, *(stems if start > low else [])]


def _arms(rng: np.random.Generator, width: float, depth: float, height: float) -> list[Mesh]:
    x, y, up = width / 2.0, depth / 2.0, rng.uniform(0.17, 0.26)
    wide = rng.uniform(0.025, 0.06)
    parts = []
    for s in (-1.0, 1.0):
        parts.append(block((s * x, 0.02, height + up), (wide, 2.0 * y, 0.02)))
        parts.append(beam((s * (x - 0.01), -0.6 * y, height - 0.03), (s * x, -0.6 * y, height + up), 0.02, 0.02))
        parts.append(beam((s * (x - 0.01), 0.8 * y, height - 0.03), (s * x, 0.8 * y, height + up), 0.02, 0.02))
    return parts


def _stretchers(rng: np.random.Generator, width: float, depth: float, height: float) -> list[Mesh]:
    x, y, level = width / 2.0 - 0.03, depth / 2.0 - 0.03, rng.uniform(0.2, 0.6) * height
    radius = rng.uniform(0.007, 0.013)
    parts = [rod((s * x, -y, level), (s * x, y, level), radius) for s in (-1, 1)]
    if rng.random() < 0.5:
        parts.append(rod((-x, 0.0, level), (x, 0.0, level), radius))
    else:
        parts += [rod((-x, s * y, level + 0.03), (x, s * y, level + 0.03), radius) for s in (-1, 1)]
    return parts


# Train, validation and test: which objects and which worlds belong to which, by a hash of names and seeds.
#
# A world draws its meshes from its own part alone, so the parts share neither a room nor an object. Parametric
# furniture is drawn anew for every world. What is chosen on the parts train and validation is reported on the part
# test.

Part = Literal["train", "validation", "test"]
PARTS: tuple[Part, ...] = ("train", "validation", "test")
_SHARES = (0.45, 0.25)
"""Of train and validation; the rest is test."""


def part_of(name: str) -> Part:
    """The part that a name belongs to."""
    draw = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big") / 2.0**64
    if draw < _SHARES[0]:
        return "train"
    return "validation" if draw < sum(_SHARES) else "test"


def families(names: Iterable[str]) -> dict[str, str]:
    """Each name with its family: the shortest name that it begins with, up to a `_`. Look-alikes stay together."""
    listed = sorted(names, key=len)
    return {name: next(other for other in listed if name == other or name.startswith(f"{other}_")) for name in listed}


def part_of_world(seed: int) -> Part:
    """The part that a world belongs to."""
    return part_of(f"world {seed}")


def seeds_of(part: Part) -> Iterator[int]:
    """The seeds of a part's worlds, from 0 up."""
    return (seed for seed in count() if part_of_world(seed) == part)


BIG_M = 0.62
"""Things with a longer diagonal stand on the floor."""
_LARGEST_M, _SMALLEST_M = 2.7, 0.05
_FORMATS = (".glb", ".ply", ".obj", ".stl")
_SAMPLES = 2500
_OUTWARD = 1e-4
"""Diagonals from a face at which a ray begins."""
_RAYS = 48
"""From each point, in all directions."""
_BIG = (
    (chair, 0.42), (stool, 0.08), (sofa, 0.08), (tables.table, 0.17), (tables.desk, 0.06),
    (tables.shelf, 0.1), (tables.cabinet, 0.09),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Model:
    """A thing as it stands: lowest point at z = 0, the footprint's middle at x = y = 0. name: of its file or kind."""

    name: str
    mesh: Mesh

    @property
    def big(self) -> bool:
        """Whether it stands on the floor."""
        return float(np.linalg.norm(self.mesh.size)) >= BIG_M

    @property
    def surface(self) -> Array:
        """(N, 3): points even over what can be seen from outside; parts that overlap hide some of each other.

        Seen is a point from which a ray leaves the mesh, from either side of its face: sheets and parts that are inside
        out are seen as cameras see them.
        """
        return self._outside[0]

    @property
    def normals(self) -> Array:
        """(N, 3) of the faces that the points of the surface lie on."""
        return self._outside[1]

    @cached_property
    def _outside(self) -> tuple[Array, Array]:
        rng = np.random.default_rng(0)
        points, normals = self.mesh.sample(_SAMPLES, rng)
        directions = rng.normal(size=(len(points), _RAYS, 3))
        side = np.sign((directions * normals[:, None]).sum(axis=-1, keepdims=True))
        step = _OUTWARD * float(np.linalg.norm(self.mesh.size))
        origins = points[:, None] + step * side * normals[:, None]
        left = ~np.isfinite(self.mesh.cast(origins.reshape(-1, 3), directions.reshape(-1, 3)))
        seen = left.reshape(len(points), _RAYS).any(axis=1)
        return points[seen], normals[seen]

    @cached_property
    def diameter(self) -> float:
        """The largest distance between two of its points."""
        from scipy.spatial import ConvexHull
        from scipy.spatial.distance import pdist

        corners = self.mesh.vertices[np.unique(self.mesh.faces)]
        return float(pdist(corners[ConvexHull(corners).vertices]).max())


@dataclass(frozen=True)
class Catalog:
    """The meshes that a world may draw from."""

    big: tuple[Path, ...] = ()
    small: tuple[Path, ...] = ()

    def draw_big(self, rng: np.random.Generator) -> Model:
        """Furniture or another large thing."""
        if self.big and rng.random() < 0.45:
            return _from_file(rng, self.big)
        makers = [maker for maker, _ in _BIG]
        maker = makers[int(rng.choice(len(makers), p=[share for _, share in _BIG]))]
        return Model(maker.__name__, standing(maker(rng)))

    def draw_small(self, rng: np.random.Generator) -> Model:
        """Something that stands on tables and shelves."""
        if self.small and rng.random() < 0.45:
            return _from_file(rng, self.small)
        return parametric_small(rng)


def parametric_small(rng: np.random.Generator) -> Model:
    """A household thing that no other world has."""
    name = str(rng.choice(sorted(SMALL)))
    return Model(name, standing(SMALL[name](rng)))


def read_catalog(folders: Sequence[Path], part: Part, used: Collection[str] = ()) -> Catalog:
    """The meshes in the folders that belong to a part; ``used``: names that choices were made on, which are train.

    Raises DatasetError (DATASET_MESH_MISSING) for a folder that is not there or has no meshes.
    """
    paths: list[Path] = []
    for folder in folders:
        found = sorted(path for path in folder.glob("*") if path.suffix in _FORMATS) if folder.is_dir() else []
        if not found:
            raise DatasetError(f"{folder} has no meshes ({', '.join(_FORMATS)})", reason="DATASET_MESH_MISSING")
        paths += found
    family = families(path.stem for path in paths)
    seen = {family[name] for name in used if name in family}
    mine = [path for path in paths if ("train" if family[path.stem] in seen else part_of(family[path.stem])) == part]
    sizes = {path: float(np.linalg.norm(_read(path).size)) for path in mine}
    big = tuple(path for path in mine if BIG_M <= sizes[path] <= _LARGEST_M)
    return Catalog(big, tuple(path for path in mine if _SMALLEST_M <= sizes[path] < BIG_M))


def _from_file(rng: np.random.Generator, paths: Sequence[Path]) -> Model:
    path = paths[int(rng.integers(len(paths)))]
    scale = rng.uniform(0.85, 1.15)
    mesh = _read(path)
    return Model(path.stem, standing(Mesh(mesh.vertices * scale, mesh.faces)))


@lru_cache(maxsize=256)
def _read(path: Path) -> Mesh:
    field, _ = load_solid(path, "object")
    return Mesh(field.vertices, field.faces)
