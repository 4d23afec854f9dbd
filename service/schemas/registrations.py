"""What POST /register takes."""

from __future__ import annotations

import math
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, field_validator

from regnf_core.options import RegistrationOptions
from service.schemas.common import Incoming, Outgoing, Sha256
from service.schemas.detections import Detection

_ROTATION_TOLERANCE = 1e-4


class FieldReference(Incoming):
    """A field by the SHA-256 of the bytes that were uploaded."""

    field: Sha256


def _bare_reference(value: Any) -> Any:
    return value["field"] if isinstance(value, dict) and value.keys() == {"field"} else value


Reference = Annotated[Sha256, BeforeValidator(_bare_reference, json_schema_input_type=Sha256 | FieldReference)]
Row = Annotated[list[Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]], Field(min_length=4, max_length=4)]


class GroundTruth(Incoming):
    """The known transform, scene coordinates to object coordinates; the result's metrics then hold the errors."""

    T_object_scene: Annotated[list[Row], Field(min_length=4, max_length=4, description="Row-major 4x4, a similarity.")]

    @field_validator("T_object_scene")
    @classmethod
    def _is_similarity(cls, rows: list[list[float]]) -> list[list[float]]:
        if not _is_similarity(rows):
            raise ValueError("not a similarity transform")
        return [[float(value) + 0.0 for value in row] for row in rows]


def _is_similarity(rows: list[list[float]]) -> bool:
    a, b, c = (row[:3] for row in rows[:3])
    squared = sum(x * x for row in (a, b, c) for x in row) / 3
    if rows[3] != [0, 0, 0, 1] or squared < 1e-12:
        return False
    products = ((a, a, 1.0), (b, b, 1.0), (c, c, 1.0), (a, b, 0.0), (b, c, 0.0), (a, c, 0.0))
    orthogonal = all(
        math.isclose(sum(x * y for x, y in zip(u, v, strict=True)) / squared, value, abs_tol=_ROTATION_TOLERANCE)
        for u, v, value in products
    )
    cross = (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
    return orthogonal and sum(x * y for x, y in zip(cross, c, strict=True)) > 0


class Question(Incoming):
    """What a registration asks, apart from the fields: the part `request` of a one-shot upload."""

    detection: Detection = Field(description="Where in the scene the object is.")
    options: RegistrationOptions = Field(default_factory=RegistrationOptions)
    seed: Annotated[int, Field(ge=0, le=2**32 - 1, description="The same seed gives the same result.")] = 0
    ground_truth: GroundTruth | None = None


class RegisterRequest(Question):
    """One registration: which scene, where in it, and which object to lay onto it."""

    scene: Reference = Field(description="The scene's field.")
    object: Reference = Field(description="The library object's field.")


class DryRunDocument(Outgoing):
    """The answer to `?dry_run=true`: the request would be accepted, and this is what it would become."""

    valid: bool
    id: str
    request: dict[str, Any]
