"""A populated scene as rigid bodies in a world: up is +z, the unit is the meter, the floor is at z = 0.

The world is the scene turned so that up is +z, and shifted along z so that the floor, if the boundary has one, is at
z = 0. What lies beneath a thing decides whether it can move.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from regnf_core.geometry.sim3 import Sim3
from regnf_core.population.collision import (
    LEVEL,
    Boxes,
    Floats,
    Integers,
    apart,
    carried,
    mesh_boxes,
    point_boxes,
    slab,
)
from regnf_core.population.proposals import BoundaryPlane

_MARGIN_M = 1.0
"""By how much floor and walls reach beyond all things."""
_TAKEN = ("world", "physics", "rest", "z_up", "base", "main", "visual", "solid")
"""Names that the files use themselves."""


@dataclass(frozen=True, eq=False)
class WorldThing:
    """name: any text · T_scene_object: its scale too · vertices (V, 3), faces (F, 3): its surface, object frame."""

    name: str
    T_scene_object: Sim3
    vertices: Floats
    faces: Integers


@dataclass(frozen=True, eq=False)
class Body:
    """A thing in the world. name: ASCII letters, digits and _, unlike all others · R, t: its pose, (3, 3) and (3,) ·

    vertices (V, 3), faces (F, 3): meters, own frame · boxes: own frame · free: whether it can move.
    """

    name: str
    R: Floats
    t: Floats
    vertices: Floats
    faces: Integers
    boxes: Boxes
    free: bool


@dataclass(frozen=True, eq=False)
class World:
    """up: (3,) unit, scene frame · boundary: planes, scene frame · meters: in a scene unit · rest: (N, 3) points of
    surface that nothing explains, scene frame, ``spacing`` apart."""

    things: Sequence[WorldThing]
    up: Floats
    boundary: Sequence[BoundaryPlane]
    meters: float
    rest: Floats
    spacing: float

    @cached_property
    def T_world_scene(self) -> Sim3:
        """From scene units to meters, up to +z, the floor's place beneath the things to z = 0."""
        R = Rotation.align_vectors(np.array([[0.0, 0.0, 1.0]]), np.asarray(self.up, np.float64)[None])[0].as_matrix()
        turned = Sim3(torch.tensor(self.meters, dtype=torch.float64), torch.from_numpy(R), torch.zeros(3).double())
        floor = max(self.boundary, key=lambda plane: float(plane.normal @ self.up), default=None)
        if floor is None or floor.normal @ self.up < LEVEL:
            return turned
        places = [thing.T_scene_object.apply(torch.from_numpy(thing.vertices)).mean(0) for thing in self.things]
        middle = np.mean([place.numpy() for place in places], axis=0) if places else np.zeros(3)
        foot = middle - self.up * (floor.height(middle) / (floor.normal @ self.up))
        shift = torch.tensor([0.0, 0.0, -self.meters * float(foot @ self.up)], dtype=torch.float64)
        return Sim3(turned.scale, turned.rotation, shift)

    @cached_property
    def static(self) -> dict[str, Boxes]:
        """Floor, walls and the rest, by name."""
        return {name: boxes for name, boxes in (*self._planes, ("rest", self._rest)) if len(boxes)}

    @cached_property
    def bodies(self) -> list[Body]:
        """The things in the same order."""
        names = _names([thing.name for thing in self.things])
        solids = [boxes for _, boxes, _ in self._solids]
        found = []
        for number, (thing, (T, boxes, points)) in enumerate(zip(self.things, self._solids, strict=True)):
            others = [*self.static.values(), *(one for other, one in enumerate(solids) if other != number)]
            R, t = T.rotation.numpy(), T.translation.numpy()
            own = boxes.seen_from(R, t)
            found.append(
                Body(names[number], R, t, thing.vertices * float(T.scale), thing.faces, own, carried(points, others))
            )
        return found

    @cached_property
    def _solids(self) -> list[tuple[Sim3, Boxes, Floats]]:
        """Of each thing: T_world_object, boxes and points of the surface, in the world."""
        found = []
        for thing in self.things:
            T = self.T_world_scene @ thing.T_scene_object
            found.append((T, *mesh_boxes(T.apply(torch.from_numpy(thing.vertices)).numpy(), thing.faces)))
        # The larger of two things has the coarser boxes: it gives way first.
        order = sorted(range(len(found)), key=lambda number: -float(np.ptp(found[number][2], axis=0).max()))
        for place, large in enumerate(order):
            for small in order[place + 1 :]:
                for one, other in ((large, small), (small, large)):
                    T, boxes, points = found[one]
                    found[one] = T, apart(boxes, found[other][1]), points
        return found

    @cached_property
    def _planes(self) -> list[tuple[str, Boxes]]:
        corners = [points for _, _, points in self._solids]
        corners += [self.T_world_scene.apply(torch.from_numpy(self.rest)).numpy()] if len(self.rest) else []
        everything = np.concatenate(corners) if corners else np.zeros((1, 3))
        center = (everything.min(axis=0) + everything.max(axis=0)) / 2.0
        radius = float(np.linalg.norm(np.ptp(everything, axis=0))) / 2.0 + _MARGIN_M
        T = self.T_world_scene
        found: list[tuple[str, Boxes]] = []
        for plane in self.boundary:
            normal = T.rotation.numpy() @ plane.normal
            offset = self.meters * plane.offset + float(normal @ T.translation.numpy())
            kind = "floor" if normal[2] > LEVEL else "wall"
            found.append((f"{kind}_{len(found)}", slab(normal, offset, center, radius)))
        return found

    @cached_property
    def _rest(self) -> Boxes:
        """What lies beside or in a thing is left out: it would push the thing. What lies beneath one carries it."""
        cell = 2.0 * self.spacing * self.meters
        points = self.T_world_scene.apply(torch.from_numpy(np.asarray(self.rest, np.float64).reshape(-1, 3))).numpy()
        for _, _, surface in self._solids if len(points) else ():
            near = cKDTree(surface).query(points, distance_upper_bound=cell)[0] < cell
            points = points[~near | (points[:, 2] < surface[:, 2].min() + cell / 8.0)]
        return point_boxes(points, cell)


def _names(given: Sequence[str]) -> list[str]:
    """Each made of ASCII letters, digits and _, and unlike the others where letters' case does not count."""
    used, found = set(_TAKEN), []
    for name in given:
        plain = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
        plain = re.sub(r"\W+", "_", plain, flags=re.ASCII).strip("_")[:80] or "thing"
        plain = plain if plain[0].isalpha() else f"thing_{plain}"
        own, count = plain, 1
        while own.lower() in used or re.match(r"(floor|wall)_\d+$", own.lower()):
            count += 1
            own = f"{plain}_{count}"
        used.add(own.lower())
        found.append(own)
    return found
