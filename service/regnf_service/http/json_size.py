"""How many values a JSON text can hold, counted before it is parsed: the bytes alone say little of the work."""

from __future__ import annotations

_SEPARATORS = (b",", b":", b"[", b"{")
MOST_VALUES = 4096
"""Twice what a search among the most candidates takes, each written at its longest."""
MOST_VALUES_WITH_CAMERAS = 16384
"""Of a request that may hold a file of cameras: some 600 of them."""
MOST_MEMBERS = 256
"""Of one object. No object of the contract has half as many."""


def count_values(text: bytes) -> int:
    """At least as many as the values and members in it: whatever separates them, in strings too."""
    return sum(map(text.count, _SEPARATORS))
