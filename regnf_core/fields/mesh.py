"""The exact signed distance field of a triangle mesh."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import igl
import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from regnf_core.errors import FieldFormatError
from regnf_core.fields.observation import ColorFunction, field_repr
from regnf_core.native.mesh_tree import MeshTree
from regnf_core.native.steps import NativeModel, steps_for
from regnf_core.schema.kinds import MeshDescription

Array = NDArray[np.float64]
_INSIDE = 0.5
_ON_SURFACE = 1e-9
_TRIED = 1000
"""Points at which normals have to agree with the winding number; else the winding number is used, ten times slower."""
_ON_EDGE = 1e-6
"""A share of a triangle's corner below which a point is on the opposite edge."""
_MOST_PARTS = 500
_MOST_TRIANGLES = 2**30
"""Of compiled code, which numbers them in 32 bits."""
_DECIDED = 0.01
"""Cosine to the normal below which the winding number says the side."""


class MeshField:
    """Distance to a triangle mesh; the generalized winding number says what is inside (Jacobson et al. 2013).

    The mesh need not be watertight. Computed on the CPU whatever device the points come from, by compiled code where
    there is such, and else by libigl; what the two say differs by rounding, see docs/families.md.
    vertices: (V, 3), own frame · faces: (F, 3) indices, normals outward · bounds: (2, 3), lowest and highest corner of
    the region where the field has meaning; None: the mesh's own bounding box · inside_above: the winding number above
    which a point is inside · colors: (V, 3) in [0, 1], of the vertices; None: the mesh has no color.
    Raises FieldFormatError (MESH_INVALID) when the arrays do not form a mesh.
    """

    color: ColorFunction
    """Only where the vertices have colors."""

    def __init__(
        self,
        vertices: ArrayLike,
        faces: ArrayLike,
        bounds: ArrayLike | None = None,
        inside_above: float = _INSIDE,
        colors: NDArray[np.float32] | None = None,
    ) -> None:
        self.vertices: Array = np.ascontiguousarray(vertices, dtype=np.float64)
        self.faces: NDArray[np.int64] = np.ascontiguousarray(faces, dtype=np.int64)
        if self.vertices.ndim != 2 or self.vertices.shape[1] != 3 or not np.isfinite(self.vertices).all():
            raise FieldFormatError("mesh vertices are not finite (V, 3) numbers", reason="MESH_INVALID")
        if self.faces.ndim != 2 or self.faces.shape[1] != 3 or len(self.faces) == 0:
            raise FieldFormatError("mesh faces are not (F, 3) with at least one triangle", reason="MESH_INVALID")
        if self.faces.min() < 0 or self.faces.max() >= len(self.vertices):
            raise FieldFormatError("a mesh face refers to a vertex that does not exist", reason="MESH_INVALID")
        self._inside_above = inside_above
        self._native: MeshTree | None = None
        self.colors = colors
        if colors is not None:
            self.color = self._color
        self._bounds = None if bounds is None else torch.as_tensor(np.asarray(bounds, dtype=np.float64))

    def transformed(self, matrix: ArrayLike) -> MeshField:
        """The field of the mesh carried by a (4, 4) affine matrix."""
        carry = np.asarray(matrix, dtype=np.float64)
        vertices = self.vertices @ carry[:3, :3].T + carry[:3, 3]
        return MeshField(vertices, self.faces, None, self._inside_above, self.colors)

    def __repr__(self) -> str:
        return field_repr(self)

    @property
    def bounds(self) -> Tensor:
        if self._bounds is not None:
            return self._bounds
        used = self.vertices[np.unique(self.faces)]
        return torch.from_numpy(np.stack((used.min(axis=0), used.max(axis=0))))

    @property
    def area(self) -> float:
        """Total area of the triangles."""
        return float(self._normals_and_areas(self.faces)[1].sum())

    @property
    def device(self) -> torch.device:
        return torch.device("cpu")

    def to(self, device: torch.device | str) -> MeshField:
        """This field: the exact distance exists on the CPU alone."""
        del device
        return self

    def signed_distance(self, points: Tensor) -> Tensor:
        return self.signed_distance_and_gradient(points)[0]

    def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N,) at points (N, 3) and its gradient (N, 3): away from the closest point of the mesh.

        On the surface itself the gradient is the closest triangle's normal.
        """
        queries = np.ascontiguousarray(points.detach().cpu().numpy(), dtype=np.float64).reshape(-1, 3)
        if len(queries) == 0:
            return torch.zeros(0), torch.zeros(0, 3)
        tree = self._sided_tree()
        if tree is not None:
            found = tree.signed_distance_and_gradient(queries)
            return _as_float32(found[0]), torch.from_numpy(found[1])
        distance, triangles, closest = self._closest(queries)
        sign = self._sign(queries, triangles, closest, distance)
        with np.errstate(divide="ignore", invalid="ignore"):
            gradient = (queries - closest) * (sign / distance)[:, None]
        touching = distance < _ON_SURFACE
        gradient[touching] = self._normals_and_areas(self.faces[triangles[touching]])[0]
        return _as_float32(sign * distance), _as_float32(gradient)

    def _sign(self, queries: Array, triangles: NDArray[Any], closest: Array, distance: Array) -> Array:
        """-1 inside and +1 outside (N,) at points (N, 3) with their closest points (N, 3) on triangles (N,)."""
        if self._normals is None:
            return self._winding_sign(queries)
        sign, undecided = self._normals.sign(queries, triangles, closest, distance)
        if undecided.any():
            sign[undecided] = self._winding_sign(queries[undecided])
        return sign

    def _winding_sign(self, queries: Array) -> Array:
        tree = self._tree()
        number = self._trees[1].winding_number(queries) if tree is None else tree.winding_number(queries)
        return np.where(number > self._inside_above, -1.0, 1.0)

    def _closest(self, queries: Array) -> tuple[Array, NDArray[Any], Array]:
        """Distances (N,) from points (N, 3), the closest triangles (N,), and the closest places on them (N, 3)."""
        tree = self._tree()
        if tree is not None:
            return tree.closest(queries)
        squared, triangles, closest = self._trees[0].squared_distance(self.vertices, self.faces, queries)
        return np.sqrt(squared), triangles.reshape(-1), closest

    def _tree(self) -> MeshTree | None:
        """Compiled code's hierarchy, made once; None where there is no compiled code: libigl works then."""
        steps = steps_for()
        if steps is None or len(self.faces) > _MOST_TRIANGLES:
            return None
        if self._native is None or self._native.steps is not steps:
            self._native = MeshTree(steps, self.vertices, self.faces, self._inside_above, _ON_SURFACE)
        return self._native

    def _sided_tree(self) -> MeshTree | None:
        """The same, which has the normals too where they say the side."""
        tree, normals = self._tree(), self._normals
        if tree is not None and normals is not None and not tree.has_normals:
            tree.use_normals(normals.of_faces, normals.of_vertices, normals.across)
        return tree

    def native_model(self) -> NativeModel | None:
        """For compiled code."""
        tree = self._sided_tree()
        return None if tree is None else tree.model()

    @cached_property
    def _normals(self) -> _PseudoNormals | None:
        """None where the side does not follow from the closest point: open meshes, and surface within other surface.

        Parts that are close to each other, and all that differs at the points that are tried, use the winding number.
        A part that crosses itself in less than about a thousandth of its surface may be missed: near the surface that
        lies inside there, the sign is wrong.
        """
        normals = _PseudoNormals.of(self)
        if normals is None or _boxes_meet(self.vertices, self.faces):
            return None
        rng = np.random.default_rng(0)
        points = self.sample_surface(_TRIED, rng)
        points += (
            rng.normal(size=points.shape) * np.geomspace(1e-4, 0.1, _TRIED)[:, None] * np.ptp(points, axis=0).max()
        )
        distance, triangles, closest = self._closest(points)
        sign, undecided = normals.sign(points, triangles, closest, distance)
        return normals if (undecided | (sign == self._winding_sign(points))).all() else None

    def _color(self, points: Tensor, directions: Tensor) -> Tensor:
        """That of the closest point of the mesh, interpolated between the corners of its triangle."""
        del directions
        assert self.colors is not None
        queries = np.ascontiguousarray(points.detach().cpu().numpy(), dtype=np.float64).reshape(-1, 3)
        if len(queries) == 0:
            return torch.zeros(0, 3)
        _, triangles, closest = self._closest(queries)
        corners = self.faces[triangles]  # (N, 3)
        shares = _barycentric(closest, self.vertices[corners])
        return _as_float32(np.einsum("nk,nkc->nc", shares, self.colors[corners]).clip(0.0, 1.0))

    def sample_surface(self, count: int, rng: np.random.Generator) -> Array:
        """``count`` points (count, 3), uniform over the surface's area."""
        areas = self._normals_and_areas(self.faces)[1]
        chosen = rng.choice(len(self.faces), size=count, p=areas / areas.sum())
        a, b = rng.random((2, count, 1))
        flip = a + b > 1.0
        a, b = np.where(flip, 1.0 - a, a), np.where(flip, 1.0 - b, b)
        corner, first, second = (self.vertices[self.faces[chosen, i]] for i in range(3))
        points: Array = corner + a * (first - corner) + b * (second - corner)
        return points

    @cached_property
    def _trees(self) -> tuple[Any, Any]:
        """libigl's hierarchies for the closest point and for the winding number: without them each call would build
        both."""
        nearest, winding = igl.AABB(), igl.FastWindingNumberBVH()
        nearest.init(self.vertices, self.faces)
        winding.init(self.vertices, self.faces)
        return nearest, winding

    def _normals_and_areas(self, faces: NDArray[np.int64]) -> tuple[Array, Array]:
        """Unit normals (F, 3) and areas (F,) of these triangles (F, 3)."""
        corner, first, second = (self.vertices[faces[:, i]] for i in range(3))
        cross = np.cross(first - corner, second - corner)
        norm = np.linalg.norm(cross, axis=1)
        return cross / np.maximum(norm, 1e-300)[:, None], norm / 2.0


@dataclass(frozen=True, eq=False)
class _PseudoNormals:
    """Normals whose side of a closed mesh is that of every point closest to where they stand (Baerentzen and Aanaes
    2005): of triangles, of edges the sum of both triangles', of vertices the sum weighted by angle.

    corners: (V, 3) · faces: (F, 3) · of_faces: (F, 3), unit normals · across: (F, 3), the triangle beyond the edge
    opposite to each corner · of_vertices: (V, 3).
    """

    corners: Array
    faces: NDArray[np.int64]
    of_faces: Array
    across: NDArray[np.int64]
    of_vertices: Array

    @classmethod
    def of(cls, mesh: MeshField) -> _PseudoNormals | None:
        """None where not every edge is shared by two triangles, one in each direction, or one has no area."""
        faces, count = mesh.faces, len(mesh.vertices)
        first, second = np.roll(faces, -1, axis=1), np.roll(faces, -2, axis=1)  # of the edge opposite to each corner
        edges, reverse = (first * count + second).reshape(-1), (second * count + first).reshape(-1)
        order, of_reverse = np.argsort(edges), np.argsort(reverse)
        paired = np.array_equal(edges[order], reverse[of_reverse]) and (np.diff(edges[order]) > 0).all()
        facing, areas = mesh._normals_and_areas(faces)
        if not paired or areas.min() <= 0.0:
            return None
        across = np.empty_like(order)
        across[of_reverse] = order // 3
        corners = mesh.vertices[faces]
        sides = np.roll(corners, -1, axis=1) - corners
        sides /= np.linalg.norm(sides, axis=-1, keepdims=True)
        angles = np.arccos(-np.einsum("fcx,fcx->fc", sides, np.roll(sides, 1, axis=1)).clip(-1.0, 1.0))
        weighted = (angles[..., None] * facing[:, None]).reshape(-1, 3)
        of_vertices: Array = np.stack([np.bincount(faces.reshape(-1), one, count) for one in weighted.T], axis=1)
        return cls(mesh.vertices, faces, facing, across.reshape(-1, 3), of_vertices)

    def sign(
        self, queries: Array, triangles: NDArray[Any], closest: Array, distance: Array
    ) -> tuple[Array, NDArray[np.bool_]]:
        """-1 or +1 (N,), and where this is not decided (N,)."""
        shares = _barycentric(closest, self.corners[self.faces[triangles]])
        none = shares < _ON_EDGE  # of these corners
        edge, vertex = none.sum(axis=1) == 1, none.sum(axis=1) >= 2
        normals = self.of_faces[triangles]
        normals[edge] += self.of_faces[self.across[triangles[edge], none[edge].argmax(axis=1)]]
        normals[vertex] = self.of_vertices[self.faces[triangles[vertex], shares[vertex].argmax(axis=1)]]
        normals /= np.linalg.norm(normals, axis=1, keepdims=True).clip(min=1e-300)
        height = np.einsum("nx,nx->n", queries - closest, normals)
        return np.where(height < 0.0, -1.0, 1.0), ~(np.abs(height) >= _DECIDED * distance)


def build_mesh(description: MeshDescription, tensors: Mapping[str, Tensor], colors: Tensor | None = None) -> MeshField:
    """The field of ``description`` with its triangles in ``tensors``. colors: (V, 3) of the vertices.

    Raises FieldFormatError (MESH_INVALID) for a face that names a vertex that does not exist.
    """
    vertices, faces = tensors["vertices"].cpu().numpy(), tensors["faces"].cpu().numpy()
    painted = None if colors is None else colors.float().cpu().numpy()
    return MeshField(vertices, faces, description.function_bounds, description.inside_above, painted)


def _boxes_meet(vertices: Array, faces: NDArray[np.int64]) -> bool:
    """Whether the bounding boxes of two connected parts of a mesh meet, or there are too many parts to ask."""
    edges = (faces.reshape(-1), np.roll(faces, -1, axis=1).reshape(-1))
    graph = coo_array((np.ones(faces.size, np.bool_), edges), shape=(len(vertices), len(vertices)))
    _, part_of = connected_components(graph, directed=False)
    used = np.unique(faces)
    parts, number = np.unique(part_of[used], return_inverse=True)
    if len(parts) > _MOST_PARTS:
        return True
    low, high = np.full((len(parts), 3), np.inf), np.full((len(parts), 3), -np.inf)
    np.minimum.at(low, number, vertices[used])
    np.maximum.at(high, number, vertices[used])
    meet = ((low[:, None] <= high) & (high[:, None] >= low)).all(-1)
    return int(meet.sum()) > len(parts)


def _barycentric(points: Array, corners: Array) -> Array:
    """Shares (N, 3) of the corners (N, 3, 3) of triangles at points (N, 3) on them; of a triangle without area, equal.

    The shares are those of the areas opposite to the corners.
    """
    sides = np.roll(corners, -1, axis=1) - points[:, None], np.roll(corners, -2, axis=1) - points[:, None]
    areas = np.linalg.norm(np.cross(*sides), axis=-1)  # (N, 3)
    whole = areas.sum(axis=1, keepdims=True)
    shares: Array = np.where(whole > 0.0, areas / np.maximum(whole, 1e-300), 1.0 / 3.0)
    return shares


def _as_float32(values: NDArray[Any]) -> Tensor:
    return torch.from_numpy(values.astype(np.float32))
