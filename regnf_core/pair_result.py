"""What the results of a batch say of one pair: a registration's document, cut down to a line."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_MEMBERS = (
    "verdict",
    "verdict_reason",
    "probability",
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
