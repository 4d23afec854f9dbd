"""Where a replacement stands: on the base of what stood there, upright, turned alike, as large."""

from __future__ import annotations

import torch
from torch import Tensor

from regnf_core.editing.edits import Match, invalid_edit
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3
from regnf_core.surface.cameras import axis_vector


def standing_alike(
    here: OrientedBox, replacement: OrientedBox, up_here: str, up_replacement: str, match: Match = "height"
) -> Sim3:
    """T_replacement_object: the middles of both bases coincide, and so do the verticals.

    here, replacement: the boxes of both surfaces, each in its own frame, axis-aligned · match: which length becomes
    equal, that along the vertical or that of the boxes' diagonals. Both keep their heading: the axis that follows the
    vertical in the order x, y, z, x is taken to mean the same in both. Raises InvalidInputError (EDIT_INVALID).
    """
    frames = [_upright(up_here), _upright(up_replacement)]
    sizes = [frame.abs().T @ box.size for frame, box in zip(frames, (here, replacement), strict=True)]
    lengths = [float(size[2] if match == "height" else size.norm()) for size in sizes]
    scale = torch.tensor(lengths[1] / lengths[0], dtype=torch.float64)
    bases = [
        box.center - frame[:, 2] * size[2] / 2.0
        for box, frame, size in zip((here, replacement), frames, sizes, strict=True)
    ]
    rotation = frames[1] @ frames[0].T
    return Sim3(scale, rotation, bases[1] - scale * (rotation @ bases[0]))


def _upright(up: str) -> Tensor:
    """(3, 3), columns: two level axes and the vertical, right-handed."""
    if up.removeprefix("-") not in ("x", "y", "z"):
        raise invalid_edit(f"the vertical is x, y or z, also with -, not {up[:20]!r}")
    sign = -1.0 if up.startswith("-") else 1.0
    first = axis_vector("xyz"[("xyz".index(up[-1]) + 1) % 3])
    vertical = sign * axis_vector(up[-1])
    return torch.stack([first, torch.linalg.cross(vertical, first), vertical], dim=1)
