"""Putting things where they stay: dropped until they touch, resting stably, piercing nothing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from benchmarks.random_worlds.mesh import Array, Mesh, turn_about_z
from benchmarks.random_worlds.models import Model
from regnf_core.geometry.box import OrientedBox

GAP_M = 0.0004
"""Left between things that touch, so that no face lies in another."""
_CONTACT_M = 0.003
"""What is nearer to its support than this counts as resting on it."""
_POINTS = 900
_START_M = 0.012
_LONGEST_DROP_M = 0.06
_STABLE_SHARE = 0.02
_FACES = 16
"""The largest faces of a hull, on which a thing may lie."""


@dataclass(frozen=True, eq=False)
class Placed:
    """Something in the room. model: None for floor and walls · T_room_model: (4, 4) rigid · mesh: in the room."""

    model: Model | None
    T_room_model: Array
    mesh: Mesh

    @cached_property
    def points(self) -> Array:
        """(N, 3): vertices and points of the surface, by which contacts are found."""
        return contact_points(self.mesh)

    @cached_property
    def outside(self) -> tuple[Array, Array]:
        """The model's surface that can be seen from outside, and its normals: both (N, 3), in the room."""
        assert self.model is not None
        turn, shift = self.T_room_model[:3, :3], self.T_room_model[:3, 3]
        return self.model.surface @ turn.T + shift, self.model.normals @ turn.T

    @cached_property
    def upward(self) -> Array:
        """(N, 3): points on faces that look up, where other things may stand."""
        points, normals = self.mesh.sample(2 * _POINTS, np.random.default_rng(1))
        return points[normals[:, 2] > 0.97]


def contact_points(mesh: Mesh) -> Array:
    """(N, 3): at most 900 vertices and 900 points of the surface."""
    used = np.unique(mesh.faces)
    if len(used) > _POINTS:
        used = used[np.linspace(0, len(used) - 1, _POINTS).astype(np.int64)]
    samples, _ = mesh.sample(_POINTS, np.random.default_rng(0))
    return np.concatenate([mesh.vertices[used], samples])


def collides(mesh: Mesh, others: Sequence[Placed]) -> bool:
    """Whether the mesh and any of the others go through each other, or one lies within the other."""
    for other in _near(mesh, others, 0.0):
        if other.mesh.pierced_by(mesh) or mesh.pierced_by(other.mesh):
            return True
        if _within(mesh, other) or _within(other.mesh, Placed(None, np.eye(4), mesh)):
            return True
    return False


def room_along(mesh: Mesh, direction: Array, others: Sequence[Placed]) -> float:
    """How far the mesh can move along a unit vector (3,) before it touches one of the others, or inf."""
    points = contact_points(mesh)
    least = math.inf
    for other in others:
        least = min(least, float(other.mesh.cast(points, np.tile(direction, (len(points), 1))).min()))
        if other.model is not None:
            back = np.tile(-direction, (len(other.points), 1))
            least = min(least, float(mesh.cast(other.points, back).min()))
    return least


def rest(model: Model, T_turn: Array, place: Array, others: Sequence[Placed]) -> Placed | None:
    """The model turned by ``T_turn`` (4, 4), dropped onto what lies under ``place`` (3,); None where it cannot stay."""
    T = T_turn.copy()
    low, high = model.mesh.moved(T).bounds
    T[:3, 3] += place - np.array([(low[0] + high[0]) / 2.0, (low[1] + high[1]) / 2.0, low[2]]) + (0.0, 0.0, _START_M)
    mesh = model.mesh.moved(T)
    if collides(mesh, others):
        return None
    down = np.array([0.0, 0.0, -1.0])
    fall = room_along(mesh, down, _under(mesh, others))
    if not fall <= _LONGEST_DROP_M + _START_M:
        return None
    T[2, 3] -= fall - GAP_M
    return settled(model, T, others)


def settled(model: Model, T: Array, others: Sequence[Placed]) -> Placed | None:
    """The model at a pose, if it pierces nothing and its weight is carried there."""
    mesh = model.mesh.moved(T)
    if collides(mesh, others) or not _carried(mesh, _under(mesh, others)):
        return None
    return Placed(model, T, mesh)


def touching(thing: Placed, direction: Array, others: Sequence[Placed], farthest: float, gap: float) -> Placed:
    """The thing moved along a level direction until ``gap`` is left to what it meets; unmoved where it cannot be."""
    assert thing.model is not None
    way = room_along(thing.mesh, direction, _level(thing.mesh, others))
    if not gap < way <= farthest:
        return thing
    T = thing.T_room_model.copy()
    T[:3, 3] += (way - gap) * direction
    return settled(thing.model, T, others) or thing


def resting_turns(model: Model, rng: np.random.Generator, lying: bool) -> Array:
    """(4, 4): as it stands, or in one of the other poses in which its hull rests, turned at random about z."""
    turn = turn_about_z(rng.uniform(0.0, 2.0 * math.pi))
    if not lying:
        return turn
    poses = _lying_poses(model.mesh)
    return turn @ poses[int(rng.integers(len(poses)))] if len(poses) else turn


def _lying_poses(mesh: Mesh) -> list[Array]:
    """Rotations (4, 4) that lay a face of the convex hull, the center of mass above it, on the ground."""
    from scipy.spatial import ConvexHull

    hull = ConvexHull(mesh.vertices[np.unique(mesh.faces)])
    normals, number = np.unique(np.round(hull.equations[:, :3], 2), axis=0, return_inverse=True)
    triangles = hull.points[hull.simplices]
    areas = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
    normals = normals[np.bincount(number.ravel(), weights=areas).argsort()[::-1][:_FACES]]
    corners, center = hull.points[hull.vertices], mesh.sample(_POINTS, np.random.default_rng(2))[0].mean(axis=0)
    size = float(np.linalg.norm(mesh.size))
    poses = []
    for normal in normals:
        R = _turned_down(normal / np.linalg.norm(normal))
        moved, middle = corners @ R.T, R @ center
        foot = moved[moved[:, 2] < moved[:, 2].min() + 0.004 * size][:, :2]
        # A pose that a touch would topple is none: the center must not lie high above a narrow foot.
        if R[2, 2] < 0.99 and _inside(foot, middle[:2], 0.12 * (middle[2] - moved[:, 2].min())):
            pose = np.eye(4)
            pose[:3, :3] = R
            poses.append(pose)
    return poses


def _turned_down(normal: Array) -> Array:
    """(3, 3): carries a unit vector to -z."""
    target = np.array([0.0, 0.0, -1.0])
    axis, cosine = np.cross(normal, target), float(normal @ target)
    if cosine < -0.9999:
        return np.diag([1.0, -1.0, -1.0])
    skew = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    turned: Array = np.eye(3) + skew + skew @ skew / (1.0 + cosine)
    return turned


def _carried(mesh: Mesh, others: Sequence[Placed]) -> bool:
    """Whether the center of mass lies above the hull of what rests on something."""
    points = contact_points(mesh)
    down = np.tile((0.0, 0.0, -1.0), (len(points), 1))
    touching_points = [points[other.mesh.cast(points, down) < _CONTACT_M] for other in others]
    for other in others:
        if other.model is not None:
            reach = mesh.cast(other.points, -np.tile((0.0, 0.0, -1.0), (len(other.points), 1)))
            touching_points.append(other.points[reach < _CONTACT_M])
    feet = np.concatenate([np.zeros((0, 3)), *touching_points])[:, :2]
    return _inside(feet, points[_POINTS // 2 :].mean(axis=0)[:2], _STABLE_SHARE * float(mesh.size[:2].min()))


def _inside(feet: Array, place: Array, margin: float) -> bool:
    """Whether a place (2,) lies within the convex hull of feet (N, 2), ``margin`` from its edge at least."""
    from scipy.spatial import ConvexHull, QhullError

    if len(feet) < 3:
        return False
    try:
        hull = ConvexHull(feet)
    except QhullError:  # all on a line
        return False
    return bool((hull.equations @ np.append(place, 1.0) <= -margin).all())


def _near(mesh: Mesh, others: Sequence[Placed], margin: float) -> list[Placed]:
    low, high = mesh.bounds[0] - margin, mesh.bounds[1] + margin
    return [one for one in others if (one.mesh.bounds[1] >= low).all() and (one.mesh.bounds[0] <= high).all()]


def _under(mesh: Mesh, others: Sequence[Placed]) -> list[Placed]:
    """What lies under the mesh, or beside it."""
    (low, high), level = mesh.bounds, slice(0, 2)
    return [
        one
        for one in others
        if (one.mesh.bounds[1, level] >= low[level]).all() and (one.mesh.bounds[0, level] <= high[level]).all()
    ]


def _level(mesh: Mesh, others: Sequence[Placed]) -> list[Placed]:
    low, high = mesh.bounds[:, 2]
    return [one for one in others if one.mesh.bounds[1, 2] > low + _CONTACT_M and one.mesh.bounds[0, 2] < high]


def _within(mesh: Mesh, other: Placed) -> bool:
    """Whether a mesh that pierces nothing lies in the other's matter: an odd count of faces above it."""
    low, high = other.mesh.bounds
    if (mesh.bounds[0] < low).any() or (mesh.bounds[1] > high).any():
        return False
    import torch

    from regnf_core.fields.mesh import MeshField

    point = torch.from_numpy(mesh.vertices[mesh.faces[:1, 0]])
    return float(MeshField(other.mesh.vertices, other.mesh.faces).signed_distance(point)[0]) < 0.0


# Detection boxes as detectors give them: too large, off center, turned any way.

LOOSE = (0.1, 0.2)
"""By how much an edge is too long."""
SHIFT = 0.05
"""Largest shift along an axis, a share of the edge."""
_TURN_SHARES = (0.5, 0.3, 0.2)


def draw_box(points: Array, T_turn: Array, rng: np.random.Generator) -> OrientedBox:
    """A box about points (N, 3): level and along the axes, along those of ``T_turn`` (4, 4), or turned any way."""
    way = int(rng.choice(3, p=_TURN_SHARES))
    turned: Array = np.asarray(Rotation.random(random_state=int(rng.integers(2**31))).as_matrix())
    R = (np.eye(3), T_turn[:3, :3], turned)[way]
    local = points @ R
    low, high = local.min(axis=0), local.max(axis=0)
    size = np.maximum(high - low, 0.02 * (high - low).max())
    middle = (low + high) / 2.0 + rng.uniform(-SHIFT, SHIFT, 3) * size
    loose = size * (1.0 + rng.uniform(*LOOSE, 3))
    return OrientedBox(torch.from_numpy(R @ middle), torch.from_numpy(loose), torch.from_numpy(R.copy()))
