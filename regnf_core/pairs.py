"""The pairs of detection and object that a batch registers."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

from regnf_core.errors import InvalidInputError


def pairs_of(pairs: Sequence[tuple[int, int]] | None, detections: int, objects: int) -> list[tuple[int, int]]:
    """Pairs by their numbers; None: each with each. Raises InvalidInputError (PAIR_UNKNOWN)."""
    if pairs is None:
        return list(product(range(detections), range(objects)))
    for pair in pairs:
        if not (isinstance(pair, Sequence) and len(pair) == 2):
            hint = "Write [(0, 0), (1, 1)]: the number of a detection, the number of an object, from 0 on."
            raise InvalidInputError(f"{pair!r} is no pair of detection and object", reason="PAIR_UNKNOWN", hint=hint)
        d, o = pair
        if not (0 <= d < detections and 0 <= o < objects):
            message = f"no pair ({d}, {o}) among the {detections} detections and {objects} objects"
            hint = "A pair is (number of the detection, number of the object); both count from 0."
            raise InvalidInputError(message, reason="PAIR_UNKNOWN", hint=hint)
    return list(pairs)
