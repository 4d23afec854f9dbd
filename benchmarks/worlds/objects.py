"""Fields of the objects: from the object's own mesh, fused from its own orbit, or cut from another walk's map."""

from __future__ import annotations

import json
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.random_worlds.fusing import Fusion, capture, draw_matter, fuse, write_dense
from benchmarks.random_worlds.mesh import Array, ExactScene
from benchmarks.random_worlds.models import Model
from benchmarks.random_worlds.symmetries import measure_symmetries
from benchmarks.random_worlds.walks import World
from benchmarks.worlds.composing import half_view
from benchmarks.worlds.recipe import Seen, orbit_sensor, see
from benchmarks.worlds.trajectories import orbit
from regnf_core.errors import RegnfError
from regnf_core.fields.build import open_field
from regnf_core.fields.observation import SdfField

ObjectKind = Literal["mesh", "orbit", "cut"]
OBJECT_KINDS: tuple[ObjectKind, ...] = ("mesh", "orbit", "cut")
_SHARES = (0.6, 0.28, 0.12)
_FRAMES = 36
_LEAST_SEEN = 0.6
"""Of an object that is cut from a map."""
_MARGIN = 0.04
_LARGEST_PART = 160


class ObjectMaker:
    """Makes the objects of one world. wanted: all of one kind; None: of any, as a seed draws · least_common: the share
    of the surface that the scene's images and the object's must both have measured: an object that was scanned from
    above is not found where it lies upside down."""

    def __init__(self, world: World, seen: Seen, home: Path, wanted: ObjectKind | None, least_common: float) -> None:
        self.world, self.seen, self._home, self._wanted = world, seen, home, wanted
        self._least_common = least_common

    def make(self, thing: int, case: int, rng: np.random.Generator) -> ObjectKind:
        """Write the field of a thing as case number ``case``, and its mesh. Returns which kind it came to be.

        Fields are in the model's frame, but those that are cut: these are in the room's.
        """
        placed = self.world.things[thing]
        assert placed.model is not None
        model = placed.model
        drawn = OBJECT_KINDS[int(rng.choice(3, p=_SHARES))] if self._wanted is None else self._wanted
        path = self._home / f"object-{case}.safetensors"
        kind: ObjectKind = "mesh"
        extra: dict[str, Array] = {}
        if drawn == "orbit" and self._common(thing, _fused_orbit(model, rng, path, self.seen.rendered)):
            kind = "orbit"
        elif drawn == "cut":
            bounds = self._cut(thing, path)
            if bounds is not None:
                kind, extra = "cut", bounds
        if kind == "mesh":
            path.unlink(missing_ok=True)
        symmetries = [json.dumps(found) for found in measure_symmetries(model)]
        np.savez(
            self._home / f"object-{case}.npz",
            vertices=model.mesh.vertices,
            faces=model.mesh.faces,
            surface=model.surface,
            symmetries=np.array(symmetries),
            **extra,
        )
        return kind

    def _common(self, thing: int, measured: NDArray[np.int64]) -> bool:
        """Whether the scene's images show enough of what other ones have measured, of each point how often."""
        return float(((self.seen.taken.seen[thing] > 0) & (measured > 0)).mean()) >= self._least_common

    def _cut(self, thing: int, path: Path) -> dict[str, Array] | None:
        """The thing's part of a map of another walk; None where that saw too little of it."""
        other = self._other
        if other is None or (other.taken.seen[thing] > 0).mean() < _LEAST_SEEN:
            return None
        if not self._common(thing, other.taken.seen[thing]):
            return None
        placed = self.world.things[thing]
        assert placed.model is not None
        T, _ = other.taken.carried(thing, placed.outside[0])
        T_fused_model = T @ placed.T_room_model
        corners = placed.model.surface @ T_fused_model[:3, :3].T + T_fused_model[:3, 3]
        margin = _MARGIN * placed.model.diameter
        bounds = np.stack([corners.min(axis=0) - margin, corners.max(axis=0) + margin])
        _write_part(self._other_map, bounds, other.fusion.voxel_m, path)
        return {"T_field_model": T_fused_model}

    @cached_property
    def _other_map(self) -> SdfField:
        """The map that objects are cut from."""
        assert self._other is not None
        path = self._home / "other.safetensors"
        fuse(self._other.taken, self._other.fusion, self._other.bounds, path)
        field = open_field(path)
        path.unlink()
        return field

    @cached_property
    def _other(self) -> Seen | None:
        """A long walk that is not the scene's."""
        try:
            return see(self.world, "long", self.seen.rendered, again=1)
        except RegnfError:
            return None


def _write_part(field: SdfField, bounds: Array, voxel: float, path: Path) -> None:
    """A box of a map as a dense grid, as a user would cut it."""
    size = bounds[1] - bounds[0]
    spacing = max(voxel, float(size.max()) / _LARGEST_PART)
    counts = np.maximum(np.ceil(size / spacing).astype(np.int64) + 1, 2)
    axes = [torch.from_numpy(bounds[0, k] + spacing * np.arange(counts[k])) for k in range(3)]
    values = field.signed_distance(torch.cartesian_prod(*axes)).numpy().reshape(counts)
    write_dense(path, values, bounds[0], spacing)


def _fused_orbit(model: Model, rng: np.random.Generator, path: Path, rendered: bool) -> NDArray[np.int64]:
    """The map of the object alone, as a scanner's orbit gives it. Returns of each point of the model's surface in how
    many images it was measured."""
    mesh = model.mesh
    sensor = orbit_sensor(rng, model.diameter, rendered)
    poses = orbit(mesh.bounds, _FRAMES, half_view(sensor.size, sensor.intrinsics), float(mesh.bounds[0, 2]))
    errors = np.tile(np.eye(4), (len(poses), 1, 1))
    groups = [(0, model.surface, model.normals)]
    taken = capture(ExactScene([mesh]), sensor, poses, errors, groups, draw_matter(1, rng) * 0, rng)
    voxel = model.diameter / rng.uniform(50.0, 110.0)
    margin = 0.1 * model.diameter
    bounds = np.stack([mesh.bounds[0] - margin, mesh.bounds[1] + margin])
    fuse(taken, Fusion(voxel, 5.0, "blocks", 5.0), bounds, path)
    return taken.seen[0]
