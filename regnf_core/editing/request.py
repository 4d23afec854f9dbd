"""Edits as a request says them, in plain (JSON) values. Torch-free: checked before any work begins.

Objects and detections have names here; ``open_edits`` turns them into fields and boxes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

from annotated_types import Ge, Le, Len, MaxLen
from pydantic import AfterValidator, BeforeValidator, Discriminator, FiniteFloat, TypeAdapter, ValidationError

from regnf_core.detections import Detection, parse_detection
from regnf_core.errors import InvalidDetectionError, InvalidInputError
from regnf_core.rgb import Rgb
from regnf_core.rotations import similarity_fault
from regnf_core.schema.closed import Closed

MOST_EDITS = 64


def _rows_of(value: Any) -> Any:
    """The rows of a 4x4: given as they are, or as ``matrix`` of a transform object."""
    rows = value.get("matrix") if isinstance(value, dict) else value
    fault = similarity_fault(rows)
    if fault is not None:
        raise ValueError(f"not a similarity transform: {fault}")
    return rows


def _detection_of(value: Any) -> Any:
    if value is None or isinstance(value, Detection):
        return value
    try:
        return parse_detection(value)
    except InvalidDetectionError as error:
        raise ValueError(str(error)) from error


def _shown(text: str) -> str:
    if not text.isprintable():
        raise ValueError("has characters that cannot be displayed")
    return text


Rows = Annotated[list[Annotated[list[FiniteFloat], Len(4, 4)]], Len(4, 4), BeforeValidator(_rows_of)]
"""A similarity transform: a row-major 4x4, or an object with ``matrix``."""
Box = Annotated[Any, BeforeValidator(_detection_of)]
"""A detection in any of its forms; a ``Detection`` once it has been read."""
ObjectName = Annotated[str, Len(1, 4096), AfterValidator(_shown)]
"""Which object's field: whoever opens the fields knows what it means (a path, a digest)."""
Name = Annotated[str, MaxLen(200), AfterValidator(_shown)]
Axis = Literal["x", "y", "z", "-x", "-y", "-z"]
Residual = Annotated[FiniteFloat, Ge(0), Le(1e9)]


@dataclass(frozen=True)
class SubstitutionRequest(Closed):
    """See :class:`regnf_core.editing.edits.Substitution`."""

    object: ObjectName
    T_object_scene: Rows
    kind: Literal["substitution"] = "substitution"
    residual: Residual | None = None
    tint: Rgb | None = None
    name: Name | None = None


@dataclass(frozen=True)
class ReplacementRequest(Closed):
    """See :class:`regnf_core.editing.edits.Replacement`."""

    object: ObjectName
    T_object_scene: Rows
    replacement: ObjectName
    kind: Literal["replacement"] = "replacement"
    T_replacement_object: Rows | None = None
    match: Literal["height", "diagonal"] = "height"
    up_object: Axis = "z"
    up_replacement: Axis = "z"
    residual: Residual | None = None
    tint: Rgb | None = None
    name: Name | None = None


@dataclass(frozen=True)
class RemovalRequest(Closed):
    """See :class:`regnf_core.editing.edits.Removal`."""

    detection: Box = None
    object: ObjectName | None = None
    T_object_scene: Rows | None = None
    kind: Literal["removal"] = "removal"
    residual: Residual | None = None
    name: Name | None = None

    def __post_init__(self) -> None:
        if (self.object is None) != (self.T_object_scene is None):
            raise ValueError("a removal needs both an object and its transform, or neither")
        if self.detection is None and self.object is None:
            raise ValueError("a removal needs a detection, or an object and its transform")


@dataclass(frozen=True)
class InsertionRequest(Closed):
    """See :class:`regnf_core.editing.edits.Insertion`."""

    object: ObjectName
    T_object_scene: Rows
    kind: Literal["insertion"] = "insertion"
    tint: Rgb | None = None
    name: Name | None = None


EditRequest = SubstitutionRequest | ReplacementRequest | RemovalRequest | InsertionRequest
_ADAPTERS: dict[str, TypeAdapter[Any]] = {
    "substitution": TypeAdapter(SubstitutionRequest),
    "replacement": TypeAdapter(ReplacementRequest),
    "removal": TypeAdapter(RemovalRequest),
    "insertion": TypeAdapter(InsertionRequest),
}
AnyEdit = Annotated[EditRequest, Discriminator("kind")]
"""For models that hold edits: told apart by ``kind``."""


def read_edits(values: Any) -> list[EditRequest]:
    """A list of edits from plain values, each with its ``kind``.

    Raises InvalidInputError (EDIT_INVALID, or INVALID_TRANSFORM and INVALID_DETECTION where that is the only fault)
    naming the member.
    """
    if not isinstance(values, list) or len(values) > MOST_EDITS:
        raise InvalidInputError(f"edits: expected a list of {MOST_EDITS} at most", reason="EDIT_INVALID")
    found: list[EditRequest] = []
    for index, value in enumerate(values):
        kind = value.get("kind") if isinstance(value, dict) else getattr(value, "kind", None)
        if kind not in list(_ADAPTERS):
            message = f"edits[{index}].kind: expected one of {', '.join(_ADAPTERS)}"
            raise InvalidInputError(message, reason="EDIT_INVALID")
        try:
            found.append(_ADAPTERS[kind].validate_python(value))
        except ValidationError as error:
            first = error.errors(include_url=False, include_input=False)[0]
            member = ".".join(str(part) for part in first["loc"])
            reason = "EDIT_INVALID"
            if first["type"] == "value_error" and member.startswith("T_"):
                reason = "INVALID_TRANSFORM"
            if first["type"] == "value_error" and member == "detection":
                reason = "INVALID_DETECTION"
            where = f"edits[{index}]" + (f".{member}" if member else "")
            message = f"{where}: {first['msg'].removeprefix('Value error, ')}"
            raise InvalidInputError(message, reason=reason) from error
    return found
