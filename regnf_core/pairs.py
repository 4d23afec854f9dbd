"""The pairs of detection and object that a batch registers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

from regnf_core.errors import InvalidInputError


def pairs_of(pairs: Sequence[tuple[int, int]] | None, detections: int, objects: int) -> list[tuple[int, int]]:
    """Pairs by their numbers; None: each with each. Raises InvalidInputError (PAIR_UNKNOWN)."""
    if pairs is None:
        return list(product(range(detections), range(objects)))
    for pair in pairs:
        if not (isinstance(pair, Sequence) and len(pair) == 2):
            hint = (
                "Write for example [(0, 0), (1, 1)]: the index of a detection and the index of an object, both from 0."
            )
            raise InvalidInputError(f"{pair!r} is not a pair of detection and object", reason="PAIR_UNKNOWN", hint=hint)
        d, o = pair
        if not (0 <= d < detections and 0 <= o < objects):
            message = f"no pair ({d}, {o}) among the {detections} detections and {objects} objects"
            hint = "A pair is (index of the detection, index of the object); both start at 0."
            raise InvalidInputError(message, reason="PAIR_UNKNOWN", hint=hint)
    return list(pairs)


# What the results of a batch say of one pair: a registration's document, cut down to a line.

_MEMBERS = (
    "verdict",
    "verdict_reason",
    "probability",
    "level",
    "T_scene_object",
    "T_object_scene",
    "center_scene",
    "uncertainty",
    "alternatives",
)
_SECONDS = "seconds_"


def short_result(document: Mapping[str, Any]) -> dict[str, Any]:
    """Verdict, transforms and metrics of a result document; the seconds of all phases as one. Of a search, the object
    too."""
    found = {name: document.get(name) for name in _MEMBERS}
    if document.get("candidates") is not None:
        found["object"] = document.get("object")
    metrics: Mapping[str, Any] = document.get("metrics") or {}
    kept = {name: value for name, value in metrics.items() if not name.startswith(_SECONDS)}
    seconds = sum(value or 0.0 for name, value in metrics.items() if name.startswith(_SECONDS))
    return found | {"metrics": kept | {"seconds": round(seconds, 4)}}
