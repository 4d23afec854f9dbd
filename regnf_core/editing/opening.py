"""From a request's edits, with names, to edits with fields."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from regnf_core.detections import Detection
from regnf_core.editing.edits import Edit, Insertion, Removal, Replacement, Substitution
from regnf_core.editing.request import (
    EditRequest,
    InsertionRequest,
    RemovalRequest,
    ReplacementRequest,
    SubstitutionRequest,
)
from regnf_core.fields.base import SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3


def open_edits(requests: Sequence[EditRequest], open_object: Callable[[str], SdfField]) -> list[Edit]:
    """The edits in the same order; ``open_object`` opens each named field once. Raises what it raises."""
    opened: dict[str, SdfField] = {}

    def field(name: str) -> SdfField:
        if name not in opened:
            opened[name] = open_object(name)
        return opened[name]

    return [_opened(request, field) for request in requests]


def _opened(request: EditRequest, field: Callable[[str], SdfField]) -> Edit:
    match request:
        case SubstitutionRequest():
            return Substitution(field(request.object), _transform(request.T_object_scene), **_common(request))
        case ReplacementRequest():
            known = request.T_replacement_object
            return Replacement(
                field(request.object),
                _transform(request.T_object_scene),
                field(request.replacement),
                None if known is None else _transform(known),
                request.match,
                request.up_object,
                request.up_replacement,
                **_common(request),
            )
        case RemovalRequest():
            known = request.T_object_scene
            return Removal(
                _box(request.detection),
                None if request.object is None else field(request.object),
                None if known is None else _transform(known),
                request.residual,
                request.name,
            )
        case InsertionRequest():
            placed = _transform(request.T_object_scene)
            return Insertion(field(request.object), placed, request.tint, request.name)


def _common(request: SubstitutionRequest | ReplacementRequest) -> dict[str, Any]:
    return {"residual": request.residual, "tint": request.tint, "name": request.name}


def _transform(rows: list[list[float]]) -> Sim3:
    return Sim3.from_matrix(rows)


def _box(detection: Detection | None) -> OrientedBox | None:
    return None if detection is None else OrientedBox.from_detection(detection)
