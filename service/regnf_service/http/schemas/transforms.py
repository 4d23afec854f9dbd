"""Similarity transforms as clients send them: a bare 4x4, or the transform object that results carry."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any

from pydantic import AfterValidator, ConfigDict, Discriminator, Field, Tag, model_validator

from regnf_core.geometry.similarity_check import Rows, inverse_rows, similarity_fault
from regnf_core.rotations import normal_quaternion, rotation_columns
from regnf_service.http.schemas.common import Coordinate, Incoming

_AGREE = 1e-4


def _similar(rows: Rows) -> Rows:
    fault = similarity_fault(rows)
    if fault is not None:
        raise ValueError(f"not a similarity transform: {fault}")
    return [[float(value) + 0.0 for value in row] for row in rows]


Row = Annotated[list[Coordinate], Field(min_length=4, max_length=4)]
Matrix = Annotated[
    list[Row], Field(min_length=4, max_length=4, description="Row-major 4x4, (s R, t)."), AfterValidator(_similar)
]
_Three = Annotated[list[Coordinate], Field(min_length=3, max_length=3)]
_Four = Annotated[list[Coordinate], Field(min_length=4, max_length=4)]


class TransformObject(Incoming):
    """A transform as results carry it. `matrix` holds all of it; the others may be left out, not contradict it."""

    matrix: Matrix
    scale: Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)] | None = None
    rotation_quaternion_xyzw: _Four | None = None
    translation: _Three | None = None

    @model_validator(mode="after")
    def _agrees(self) -> TransformObject:
        if not (self._same_scale() and self._same_rotation() and self._same_translation()):
            raise ValueError("scale, rotation_quaternion_xyzw or translation contradict the matrix")
        return self

    def _matrix_scale(self) -> float:
        return math.sqrt(sum(value * value for row in self.matrix[:3] for value in row[:3]) / 3)

    def _same_scale(self) -> bool:
        return self.scale is None or math.isclose(self.scale, self._matrix_scale(), rel_tol=_AGREE)

    def _same_translation(self) -> bool:
        return self.translation is None or _close(self.translation, [row[3] for row in self.matrix[:3]])

    def _same_rotation(self) -> bool:
        if self.rotation_quaternion_xyzw is None:
            return True
        if not any(self.rotation_quaternion_xyzw):
            return False
        scale = self._matrix_scale()
        columns = rotation_columns(normal_quaternion(self.rotation_quaternion_xyzw))
        turned = zip(*columns, strict=True)
        return all(
            _close(row, [value / scale for value in held[:3]])
            for row, held in zip(turned, self.matrix[:3], strict=True)
        )


def _close(a: Sequence[float], b: Sequence[float]) -> bool:
    return all(math.isclose(p, q, rel_tol=_AGREE, abs_tol=_AGREE) for p, q in zip(a, b, strict=True))


def _spelling(value: Any) -> str:
    return "transform_object" if isinstance(value, dict | TransformObject) else "matrix_rows"


Similarity = Annotated[
    Annotated[Matrix, Tag("matrix_rows")] | Annotated[TransformObject, Tag("transform_object")],
    Discriminator(_spelling),
]
SPELLINGS = frozenset({"matrix_rows", "transform_object", "object_pose"})


def rows_of(transform: Rows | TransformObject) -> Rows:
    """The 4x4 of either spelling."""
    return transform.matrix if isinstance(transform, TransformObject) else transform


def _one_direction(schema: dict[str, Any]) -> None:
    # within allOf, as in RegisterRequest
    schema["allOf"] = [{"oneOf": [{"required": ["T_object_scene"]}, {"required": ["T_scene_object"]}]}]
    for name in ("T_object_scene", "T_scene_object"):
        schema["properties"][name].pop("default")


class ObjectPose(Incoming):
    """Where the object is, in one of two directions."""

    model_config = ConfigDict(json_schema_extra=_one_direction)

    T_object_scene: Similarity | None = Field(None, description="Scene coordinates to object coordinates.")
    T_scene_object: Similarity | None = Field(
        None, description="Object coordinates to scene coordinates, as results have it."
    )

    @model_validator(mode="after")
    def _has_one(self) -> ObjectPose:
        if (self.T_object_scene is None) == (self.T_scene_object is None):
            raise ValueError("exactly one of `T_object_scene` and `T_scene_object` must be given")
        return self

    @property
    def rows(self) -> Rows:
        """The 4x4 T_object_scene."""
        if self.T_object_scene is not None:
            return rows_of(self.T_object_scene)
        assert self.T_scene_object is not None, "one of both is given"
        return inverse_rows(rows_of(self.T_scene_object))


def _spelling_of_start(value: Any) -> str:
    if isinstance(value, ObjectPose):
        return "object_pose"
    has_direction = isinstance(value, dict) and not value.keys().isdisjoint(ObjectPose.model_fields)
    return "object_pose" if has_direction else _spelling(value)


Start = Annotated[
    Annotated[Matrix, Tag("matrix_rows")]
    | Annotated[TransformObject, Tag("transform_object")]
    | Annotated[ObjectPose, Tag("object_pose")],
    Discriminator(_spelling_of_start),
]


def start_rows(start: Rows | TransformObject | ObjectPose) -> Rows:
    """The 4x4 T_object_scene of any spelling."""
    return start.rows if isinstance(start, ObjectPose) else rows_of(start)
