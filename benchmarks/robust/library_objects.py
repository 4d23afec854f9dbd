"""A library of 64 distinct objects: the given meshes, stretched and incomplete ones, and simple furniture.

No two are similar in the sense of geometry: no rotation, shift and scale carries one onto another.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from benchmarks.simple_meshes import box, revolved, together
from regnf_core.fields.mesh import MeshField
from regnf_core.importing.mesh_file import load_mesh

GIVEN = (
    "painted_wooden_chair_01", "dining_chair_02", "modern_arm_chair_01", "modern_arm_chair_01_nopillow",
    "mid_century_lounge_chair", "woodentable_02", "coffeetable_01", "side_table_01", "round_wooden_table_02",
    "schoolchair_01", "plastic_monobloc_chair_01", "outdoor_folding_chair", "boombox", "ceramic_vase_01",
    "vintage_electric_kettle", "concrete_cat_statue", "ycb_002_master_chef_can", "ycb_004_sugar_box",
)  # fmt: skip
"""The meshes as they are, by file name."""


class Stretch(NamedTuple):
    """A given mesh, one axis (x 0, y 1, z 2) made longer."""

    of: str
    axis: int
    factor: float


class Removal(NamedTuple):
    """A given mesh without the parts whose middle lies between two corners; ``name`` says what is left."""

    of: str
    name: str
    lower: tuple[float, float, float]
    upper: tuple[float, float, float]


STRETCHES = (
    Stretch("painted_wooden_chair_01", 0, 1.35), Stretch("dining_chair_02", 2, 1.3),
    Stretch("modern_arm_chair_01", 0, 1.6), Stretch("modern_arm_chair_01_nopillow", 1, 1.3),
    Stretch("mid_century_lounge_chair", 2, 1.25), Stretch("woodentable_02", 0, 1.5),
    Stretch("coffeetable_01", 2, 1.6), Stretch("side_table_01", 2, 1.4),
    Stretch("round_wooden_table_02", 0, 1.3), Stretch("schoolchair_01", 1, 1.25),
    Stretch("plastic_monobloc_chair_01", 0, 1.45), Stretch("outdoor_folding_chair", 2, 1.2),
    Stretch("boombox", 1, 1.6), Stretch("ceramic_vase_01", 2, 1.35), Stretch("vintage_electric_kettle", 2, 1.3),
    Stretch("concrete_cat_statue", 1, 1.4), Stretch("ycb_002_master_chef_can", 2, 1.5),
    Stretch("ycb_004_sugar_box", 1, 1.25),
)  # fmt: skip
_FAR = 9.0
REMOVALS = (
    Removal("mid_century_lounge_chair", "without legs", (-_FAR, -_FAR, -_FAR), (_FAR, _FAR, 0.2)),
    Removal("mid_century_lounge_chair", "without back", (-_FAR, 0.1, 0.5), (_FAR, _FAR, _FAR)),
    Removal("modern_arm_chair_01", "without one arm", (-_FAR, -_FAR, -_FAR), (-0.3, _FAR, _FAR)),
    Removal("modern_arm_chair_01_nopillow", "without back", (-_FAR, 0.2, 0.5), (_FAR, _FAR, _FAR)),
    Removal("dining_chair_02", "without back", (-_FAR, -_FAR, 0.5), (_FAR, _FAR, _FAR)),
    Removal("painted_wooden_chair_01", "without back", (-_FAR, -_FAR, 0.46), (_FAR, _FAR, _FAR)),
    Removal("side_table_01", "without middle board", (-0.1, -0.1, 0.3), (0.1, 0.1, 0.4)),
    Removal("round_wooden_table_02", "without top", (-0.1, -0.1, 0.7), (0.1, 0.1, _FAR)),
    Removal("schoolchair_01", "frame alone", (-_FAR, -_FAR, 0.6), (_FAR, _FAR, _FAR)),
    Removal("outdoor_folding_chair", "without back", (-_FAR, -_FAR, 0.5), (_FAR, _FAR, _FAR)),
    Removal("coffeetable_01", "without upper half", (-_FAR, -_FAR, 0.3), (_FAR, _FAR, _FAR)),
)  # fmt: skip


def library_meshes(meshes: Path) -> list[tuple[str, MeshField]]:
    """All 64, by name, in meters, z up; ``meshes`` is the folder of the given ones."""
    given = {name: load_mesh(meshes / f"{name}.glb") for name in GIVEN}
    stretched = {
        f"{one.of} stretched {one.factor:g} along {'xyz'[one.axis]}": stretch(given[one.of], one.axis, one.factor)
        for one in STRETCHES
    }
    incomplete = {f"{one.of} {one.name}": without(given[one.of], one) for one in REMOVALS}
    return list((given | stretched | incomplete | simple_furniture()).items())


def stretch(mesh: MeshField, axis: int, factor: float) -> MeshField:
    """The mesh made longer along one axis."""
    matrix = np.eye(4)
    matrix[axis, axis] = factor
    return mesh.transformed(matrix)


def without(mesh: MeshField, removal: Removal) -> MeshField:
    """The mesh without those connected parts whose box has its middle in the removal's."""
    places, same = np.unique(np.round(mesh.vertices, 6), axis=0, return_inverse=True)
    faces = same.reshape(-1)[mesh.faces]
    a, b = np.concatenate([faces[:, :2], faces[:, 1:]]).T
    count = len(places)
    _, part = connected_components(coo_matrix((np.ones(len(a)), (a, b)), shape=(count, count)), directed=False)
    kept = []
    for number in range(part.max() + 1):
        corners = places[part == number]
        middle = (corners.min(0) + corners.max(0)) / 2
        if not ((middle >= removal.lower) & (middle <= removal.upper)).all():
            kept.append(number)
    return MeshField(places, faces[np.isin(part[faces[:, 0]], kept)])


def simple_furniture() -> dict[str, MeshField]:
    """Seventeen pieces made of boxes and turned profiles, meters. Parts reach into each other, as real meshes' do."""
    return {
        "square table": four_legs(0.9, 0.9, 0.74, 0.03, 0.06),
        "long table": four_legs(2.0, 0.8, 0.75, 0.04, 0.09),
        "low table": four_legs(1.0, 0.6, 0.35, 0.08, 0.05),
        "bed": together(four_legs(1.0, 2.0, 0.5, 0.3, 0.08), box((-0.5, 0.98, 0.0), (0.5, 1.06, 1.0))),
        "bench": together(box((-0.7, -0.18, 0.4), (0.7, 0.18, 0.46)), *posts((-0.6, 0.54), -0.16, 0.06, 0.32, 0.43)),
        "wide shelf": shelf(1.2, 0.3, 0.8, 3),
        "tall shelf": shelf(0.5, 0.35, 1.9, 6),
        "cabinet": together(shelf(0.8, 0.45, 0.9, 2), box((-0.4, 0.2, 0.0), (0.4, 0.225, 0.9))),
        "round stool": revolved([(0, 0), (0.2, 0), (0.2, 0.03), (0.03, 0.05), (0.03, 0.6), (0.18, 0.62), (0, 0.66)]),
        "floor lamp": revolved([(0, 0), (0.14, 0), (0.015, 0.03), (0.015, 1.3), (0.2, 1.3), (0.12, 1.6), (0, 1.6)]),
        "table lamp": revolved([(0, 0), (0.07, 0), (0.09, 0.1), (0.02, 0.22), (0.13, 0.22), (0.08, 0.4), (0, 0.4)]),
        "pedestal": revolved([(0, 0), (0.25, 0), (0.25, 0.1), (0.15, 0.15), (0.15, 0.8), (0.22, 0.9), (0, 0.9)], 6),
        "parcel": box((-0.16, -0.12, 0.0), (0.16, 0.12, 0.22)),
        "steps": together(*(box((-0.25, 0.2 * i, 0.0), (0.25, 0.6, 0.2 * (i + 1))) for i in range(3))),
        "crate": together(
            box((-0.3, -0.2, 0.0), (0.3, 0.2, 0.02)),
            *posts((-0.3, 0.28), -0.2, 0.02, 0.4, 0.3),
            *(box((-0.3, y, 0.0), (0.3, y + 0.02, 0.3)) for y in (-0.2, 0.18)),
        ),
        "corner sofa": together(
            box((-1.0, -0.4, 0.0), (1.0, 0.4, 0.42)),
            box((-1.0, 0.3, 0.0), (1.0, 0.6, 0.8)),
            box((-1.0, -1.2, 0.0), (-0.2, 0.4, 0.42)),
        ),
        "ladder": together(
            *posts((-0.25, 0.2), -0.03, 0.05, 0.06, 1.6),
            *(box((-0.24, -0.02, z), (0.24, 0.02, z + 0.04)) for z in (0.25, 0.55, 0.85, 1.15, 1.45)),
        ),
    }


def posts(places: Sequence[float], y: float, width: float, depth: float, height: float) -> list[MeshField]:
    """Upright boxes from z = 0, their lowest x at ``places``, meters."""
    return [box((x, y, 0.0), (x + width, y + depth, height)) for x in places]


def four_legs(width: float, depth: float, height: float, slab: float, leg: float) -> MeshField:
    """A table: a slab on four square legs, meters."""
    x, y = width / 2, depth / 2
    legs = [post for front in (-y, y - leg) for post in posts((-x, x - leg), front, leg, leg, height - slab / 2)]
    return together(box((-x, -y, height - slab), (x, y, height)), *legs)


def shelf(width: float, depth: float, height: float, boards: int) -> MeshField:
    """Two sides and ``boards`` boards between them, the lowest and the highest at the ends, meters."""
    x, y, thick = width / 2, depth / 2, 0.02
    heights = np.linspace(0.0, height - thick, boards)
    return together(
        *posts((-x, x - thick), -y, thick, depth, height),
        *(box((-x, -y, z), (x, y, z + thick)) for z in heights),
    )
