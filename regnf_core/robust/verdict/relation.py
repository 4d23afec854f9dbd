"""How one pose differs from another, in words: '180 degrees about z'."""

from __future__ import annotations

import math

from torch import Tensor

from regnf_core.geometry.sim3 import Sim3
from regnf_core.robust.constants import RELATION

_NEARLY = math.cos(math.radians(RELATION.axis_angle_deg))


def relation(T_other: Sim3, T_best: Sim3, free_axis: Tensor | None = None) -> str:
    """The turn of the object frame between two single poses; axes are the object frame's.

    free_axis: (3,), object frame, about which any turn would do as well.
    """
    difference = (T_other @ T_best.inverse()).log()
    omega, factor = difference[:3], math.exp(float(difference[6]))
    angle = float(omega.norm())
    words = []
    if angle > math.radians(RELATION.min_angle_deg):
        x, y, z = (omega / angle).tolist()
        names = {name: value for name, value in zip("xyz", (x, y, z), strict=True) if abs(value) >= _NEARLY}
        degrees = round(math.degrees(angle))
        if names:
            (name, value), *_ = names.items()
            sign = "-" if value < 0 and degrees != 180 else ""
            words.append(f"{sign}{degrees} degrees about {name}")
        else:
            words.append(f"{degrees} degrees about ({x:.2f}, {y:.2f}, {z:.2f})")
        if free_axis is not None and abs(float(omega @ free_axis)) >= _NEARLY * angle:
            words.append("as any turn about this axis")
    if abs(factor - 1.0) > RELATION.min_scale_change:
        words.append(f"{factor:.2f} times the scale")
    return ", ".join(words) or "shifted"
