"""Train, validation and test: which objects and which worlds belong to which, by a hash of names and seeds.

A world draws its meshes from its own part alone, so the parts share neither a room nor an object. Parametric furniture
is drawn anew for every world. What is chosen on the parts train and validation is reported on the part test.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from itertools import count
from typing import Literal

Part = Literal["train", "validation", "test"]
PARTS: tuple[Part, ...] = ("train", "validation", "test")
_SHARES = (0.45, 0.25)
"""Of train and validation; the rest is test."""


def part_of(name: str) -> Part:
    """The part that a name belongs to."""
    draw = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big") / 2.0**64
    if draw < _SHARES[0]:
        return "train"
    return "validation" if draw < sum(_SHARES) else "test"


def families(names: Iterable[str]) -> dict[str, str]:
    """Each name with its family: the shortest name that it begins with, up to a `_`. Look-alikes stay together."""
    listed = sorted(names, key=len)
    return {name: next(other for other in listed if name == other or name.startswith(f"{other}_")) for name in listed}


def part_of_world(seed: int) -> Part:
    """The part that a world belongs to."""
    return part_of(f"world {seed}")


def seeds_of(part: Part) -> Iterator[int]:
    """The seeds of a part's worlds, from 0 up."""
    return (seed for seed in count() if part_of_world(seed) == part)
