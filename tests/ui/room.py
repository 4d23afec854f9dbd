"""A room and a chair of one's own, as files that a user may have: the room as .ply, the chair as .glb."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

CHAIR_AT = (0.9, -0.5)
CHAIR_TURN = 0.6
CHAIR_SCALE = 2.5
"""Units of the chair's own file to a meter."""


def chair() -> trimesh.Trimesh:
    """An armchair with one arm, standing on the plane z = 0, in meters; it has no symmetry."""
    legs = [_box((x, y, 0.2), (0.06, 0.06, 0.4)) for x in (-0.24, 0.24) for y in (-0.24, 0.24)]
    seat, back = _box((0, 0, 0.43), (0.56, 0.56, 0.1)), _box((0, -0.25, 0.72), (0.52, 0.07, 0.56))
    arm, post = _box((0.26, 0.02, 0.68), (0.06, 0.44, 0.06)), _box((0.26, 0.2, 0.56), (0.05, 0.05, 0.22))
    cushion = trimesh.creation.icosphere(3, 0.16)
    cushion.apply_scale([1.2, 1.0, 0.5])
    cushion.apply_translation([-0.06, 0.02, 0.52])
    return _whole([*legs, seat, back, arm, post, cushion])


def room() -> trimesh.Trimesh:
    """A room of 4 by 3.2 by 2.4 m seen from within, with a table, a cupboard, a lamp and the chair; z is up."""
    walls = trimesh.creation.box((4.0, 3.2, 2.4))
    walls.apply_translation((0, 0, 1.2))
    walls.invert()
    table = [_box((-0.9, 0.5, 0.72), (1.3, 0.75, 0.05))]
    table += [_box((-0.9 + x, 0.5 + y, 0.35), (0.07, 0.07, 0.7)) for x in (-0.55, 0.55) for y in (-0.3, 0.3)]
    cupboard = _box((1.4, 1.33, 0.8), (0.9, 0.5, 1.6))
    lamp = trimesh.creation.cylinder(0.09, 0.35)
    lamp.apply_translation((-1.2, 0.55, 0.92))
    seat = chair()
    seat.apply_transform(trimesh.transformations.rotation_matrix(CHAIR_TURN, (0, 0, 1)))
    seat.apply_translation((*CHAIR_AT, 0.002))
    parts = [(walls, (196, 188, 174)), (cupboard, (122, 92, 66)), (lamp, (210, 170, 60)), (seat, (60, 110, 150))]
    parts += [(part, (150, 118, 84)) for part in table]
    return _whole([_painted(mesh.subdivide_to_size(0.08), color) for mesh, color in parts])


def write_room_and_chair(folder: Path) -> tuple[Path, Path]:
    """The files room.ply and chair.glb; the chair has its own unit and stands elsewhere."""
    scene, obj = folder / "room.ply", folder / "chair.glb"
    room().export(scene)
    own = chair()
    own.apply_scale(CHAIR_SCALE)
    own.apply_translation((3.0, 1.0, 0.0))
    own.export(obj)
    return scene, obj


def _box(center: tuple[float, float, float], size: tuple[float, float, float]) -> trimesh.Trimesh:
    made = trimesh.creation.box(size)
    made.apply_translation(center)
    return made


def _whole(parts: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    whole = trimesh.util.concatenate(parts)
    assert isinstance(whole, trimesh.Trimesh)
    return whole


def _painted(mesh: trimesh.Trimesh, color: tuple[int, int, int]) -> trimesh.Trimesh:
    colors: NDArray[np.uint8] = np.full((len(mesh.vertices), 4), 255, np.uint8)
    colors[:, :3] = color
    mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=colors)
    return mesh
