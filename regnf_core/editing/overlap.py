"""Edits of one scene must not meddle with each other: each changes a place of its own."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import torch
from torch import Tensor

from regnf_core.editing.placed_object import PlacedObject
from regnf_core.errors import InvalidInputError
from regnf_core.geometry.box import OrientedBox

_POINTS = 12
"""Along each edge of a box, to tell how much of two solids is common."""
_MOST_COMMON = 0.05
"""Share of the smaller of two objects' matter that may lie in the other: things touch, and poses are not exact."""
_MOST_OF_BOX = 0.5
"""Share of a thing's matter that may lie in a box that another edit clears."""

Place = PlacedObject | OrientedBox


@dataclass(frozen=True, eq=False)
class Occupied:
    """What one edit takes away and what it puts in."""

    removed: Place | None
    placed: PlacedObject | None


def require_apart(edits: Sequence[Occupied]) -> None:
    """Raises InvalidInputError (EDITS_OVERLAP): two edits take away the same thing, or put matter in one place."""
    for (first, one), (second, other) in combinations(enumerate(edits), 2):
        for a, b in _rivals(one, other):
            most = _MOST_COMMON if isinstance(a, PlacedObject) and isinstance(b, PlacedObject) else _MOST_OF_BOX
            if _common(a, b) > most:
                message = f"edits {first} and {second} change the same place"
                hint = "Leave one of them out, or make one after the other: an edited scene can be edited again."
                raise InvalidInputError(message, reason="EDITS_OVERLAP", hint=hint)


def _rivals(one: Occupied, other: Occupied) -> Iterator[tuple[Place, Place]]:
    if one.removed is not None and other.removed is not None:
        yield one.removed, other.removed
    if one.placed is not None and other.placed is not None:
        yield one.placed, other.placed


def _common(a: Place, b: Place) -> float:
    """The larger of the shares of each one's matter that lies in the other."""
    if not _near(a, b):
        return 0.0
    return max(_share_within(a, b), _share_within(b, a))


def _share_within(a: Place, b: Place) -> float:
    points = _points(a)
    return float(_within(b, points).float().mean()) if len(points) else 0.0


def _points(place: Place) -> Tensor:
    """Points (N, 3) spread over the matter of an object, or over a box."""
    box = place.box if isinstance(place, PlacedObject) else place
    steps = (torch.arange(_POINTS, dtype=torch.float64) + 0.5) / _POINTS - 0.5
    points = (box.center + (torch.cartesian_prod(steps, steps, steps) * box.size) @ box.rotation.T).float()
    if isinstance(place, OrientedBox):
        return points
    distance = place.signed_distance(points).cpu()
    thin = float((box.size / _POINTS).norm()) / 2.0  # legs and plates fall between the points
    return points[distance < (0.0 if int((distance < 0).sum()) >= _POINTS else thin)]


def _within(place: Place, points: Tensor) -> Tensor:
    if isinstance(place, OrientedBox):
        return place.contains(points)
    return place.signed_distance(points).cpu() < 0.0


def _near(a: Place, b: Place) -> bool:
    boxes = [place.box if isinstance(place, PlacedObject) else place for place in (a, b)]
    distance = float((boxes[0].center - boxes[1].center).norm())
    return distance <= 0.5 * (boxes[0].diagonal + boxes[1].diagonal)
