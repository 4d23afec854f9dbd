"""The objects' own symmetries: turns about z through the middle of the object's box, the origin of its frame.

Checked on the meshes: surface points moved by them lie within 0.1 % of the diagonal of the mesh in the mean. What comes
near that without being a symmetry (1 % in the mean) is told apart: a good method may see the difference.
"""

from __future__ import annotations

import math

import torch

from benchmarks.symmetric_errors import ContinuousSymmetry, Symmetries
from regnf_core import Sim3

TURNS = {"et": 4, "t": 2, "wt": 2, "round_wooden_table_02": 2}
"""Turns about z that carry the object onto itself, the identity counted."""
ANY_TURN = ("ceramic_vase_01", "ycb_002_master_chef_can")
"""Objects that every turn about z carries onto themselves."""
_X, _Y, _Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
_NEARLY = {
    "round_wooden_table_02": [(_Z, 90.0), (_Z, 270.0)],
    "boombox": [(_Z, 180.0)],
    "ycb_002_master_chef_can": [(_X, 180.0)],
    "ycb_004_sugar_box": [(_X, 180.0), (_Y, 180.0), (_Z, 180.0)],
}


def declared(name: str) -> Symmetries:
    """The true symmetries of an object, in its own frame."""
    if name in ANY_TURN:
        return Symmetries(continuous=[ContinuousSymmetry(_Z)])
    order = TURNS.get(name, 1)
    return Symmetries(discrete=[turn(_Z, 360.0 * k / order) for k in range(1, order)])


def nearly(name: str) -> list[Sim3]:
    """Turns that nearly carry the object onto itself, in its own frame."""
    return [turn(axis, degrees) for axis, degrees in _NEARLY.get(name, [])]


def in_frame(symmetries: Symmetries, T_new_object: Sim3) -> Symmetries:
    """The same symmetries in another frame of the object."""
    back = T_new_object.inverse()
    axes = []
    for one in symmetries.continuous:
        axis = T_new_object.rotation @ torch.tensor(one.axis, dtype=torch.float64)
        offset = T_new_object.apply(torch.tensor(one.offset, dtype=torch.float64)[None])[0]
        axes.append(ContinuousSymmetry(axis.tolist(), offset.tolist()))
    return Symmetries([T_new_object @ one @ back for one in symmetries.discrete], axes)


def turn(axis: tuple[float, float, float], degrees: float) -> Sim3:
    """A turn about an axis through the origin."""
    half = math.radians(degrees) / 2
    x, y, z = (math.sin(half) * part for part in axis)
    return Sim3.from_quaternion(1.0, [x, y, z, math.cos(half)], [0.0, 0.0, 0.0])
