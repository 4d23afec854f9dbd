"""What worlds are furnished with: meshes from files and parametric furniture, big things and small ones."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np

from regnf_core.errors import DatasetError
from regnf_core.importing.mesh_file import load_solid
from regnf_data.worlds import seats, tables
from regnf_data.worlds.mesh import Array, Mesh, standing
from regnf_data.worlds.small_things import SMALL
from regnf_data.worlds.split import Part, families, part_of

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
    (seats.chair, 0.42), (seats.stool, 0.08), (seats.sofa, 0.08), (tables.table, 0.17), (tables.desk, 0.06),
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
