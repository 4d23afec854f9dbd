"""How the surface lies in a field's bounds: what tells a room from a thing turned inside out, and from no thing at all.

A thing stands in free space. A room's free space is enclosed, and fills most of what its surface encloses; that of a
thing turned inside out is the thing itself, which fills little of its own convex hull.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from regnf_core.errors import FieldFormatError

_RIM = 0.05
"""This share of each edge of the bounds, at either end, is their rim."""
_ALL_ROUND = 0.95
"""More than this share of the bounds' faces inside matter: free space is enclosed."""
_FILLED = 0.4
"""Free space that fills less of its surface's convex hull is a thing's; of furnished rooms it fills three quarters."""
_MOSTLY = 0.9
"""More of the bounds inside matter leaves too little free space for a room."""
_TOUCHED = 0.02
"""More of the bounds' faces inside matter: the surface may be where the bounds cut it."""
_NEARER = 0.5
"""A distance below this share of that to the bounds is to a surface that is not at the bounds."""
INSIST = "with accept_implausible: true in the description it is taken"


@dataclass(frozen=True)
class Box:
    """Bounds. low, high: (3,)."""

    low: Tensor
    high: Tensor


def measured_enclosure(points: Tensor, distance: Tensor, surface: Tensor, slope: float, box: Box) -> dict[str, float]:
    """free_share_of_hull, inner_share_inside (without the rim), and inner_clearance: the least of the distances there,
    as a share of that to the bounds; 0 where all of it is matter.

    points: (N, 3) anywhere in the box · distance: (N,) there · surface: (M, 3) · slope: of the field at its surface.
    """
    edge = box.high - box.low
    rim = torch.minimum(points - box.low, box.high - points)  # (N, 3)
    inner = (rim > _RIM * edge).all(dim=-1)
    inside = distance < 0
    free = inner & ~inside
    clearance = distance[free] / (slope * rim[free].amin(dim=-1))
    return {
        "free_share_of_hull": _free_share_of_hull(points, inside, surface),
        "inner_share_inside": float(inside[inner].float().mean()),
        "inner_clearance": float(clearance.min()) if len(clearance) else 0.0,
    }


def _free_share_of_hull(points: Tensor, inside: Tensor, surface: Tensor) -> float:
    """1 where the surface has no hull."""
    try:
        hull = ConvexHull(surface.double().numpy())
    except (QhullError, ValueError):  # flat, or of fewer points than a hull has
        return 1.0
    planes = torch.from_numpy(hull.equations).float()
    within = (points @ planes[:, :3].T + planes[:, 3]).amax(dim=-1) < 0
    return float((~inside[within]).float().mean()) if within.any() else 1.0


def require_sound_enclosure(measured: dict[str, float], sign: int | None) -> None:
    """Raise FieldFormatError (FIELD_IMPLAUSIBLE) for a field that is inside out, or has no surface but at its bounds.

    sign: the one that the values are read with, where nobody has said it; None: somebody has.
    """
    at_bounds, within = measured["share_inside_at_bounds"], measured["inner_share_inside"]
    if within == 1.0 and at_bounds > 0.5:
        raise _implausible(
            "everything is inside matter, but for places at the bounds: say bounds that have free space round the"
            " surface, or the other sign"
        )
    if within == 0.0 and at_bounds > _TOUCHED and measured["inner_clearance"] > _NEARER:
        raise _implausible("it has a surface at its bounds only: scale or bounds may be wrong; say them")
    filled = measured["free_share_of_hull"]
    if sign is None or at_bounds <= _ALL_ROUND:
        return
    if filled < _FILLED or measured["share_inside"] > _MOSTLY:
        share = 100.0 * (1.0 - measured["share_inside"])
        raise _implausible(
            f"it is matter all round its bounds, and free space is {share:.0f} % of them and {100.0 * filled:.0f} % of"
            f" what its surface encloses: a thing turned inside out; say sign {-sign} to turn it round, or sign {sign}"
            " if it is a room as it should be"
        )


def _implausible(what: str) -> FieldFormatError:
    return FieldFormatError(f"{what}; {INSIST}", reason="FIELD_IMPLAUSIBLE")
