"""What POST /register takes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    StrictBool,
    StringConstraints,
    Tag,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_core import PydanticCustomError

from regnf_core.document import Outgoing, Sha256
from regnf_core.options import RegistrationOptions
from regnf_core.rotations import Rows, inverse_rows, normal_quaternion, rotation_columns, similarity_fault
from regnf_service.http.schemas.detections import AnyDetection
from regnf_service.http.schemas.library import (
    BY_DIGEST,
    MAX_SELECTED,
    Choice,
    LibraryReference,
    LibrarySelection,
    Named,
    Selected,
)
from regnf_service.http.schemas.results import Coordinate, Incoming
from regnf_state.registration_request import RegistrationRequest

# Similarity transforms as clients send them: a bare 4x4, or the transform object that results carry.

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
    """A transform in the form of a result. `matrix` is complete; the other members are optional and must agree with
    it."""

    matrix: Matrix
    scale: Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)] | None = None
    rotation_quaternion_xyzw: _Four | None = None
    translation: _Three | None = None

    @model_validator(mode="after")
    def _agrees(self) -> TransformObject:
        scale = math.sqrt(sum(value * value for row in self.matrix[:3] for value in row[:3]) / 3)
        agrees = self.scale is None or math.isclose(self.scale, scale, rel_tol=_AGREE)
        if self.translation is not None:
            agrees = agrees and _close(self.translation, [row[3] for row in self.matrix[:3]])
        if self.rotation_quaternion_xyzw is not None:
            agrees = agrees and any(self.rotation_quaternion_xyzw) and self._is_turned(scale)
        if not agrees:
            raise ValueError("scale, rotation_quaternion_xyzw or translation do not match the matrix")
        return self

    def _is_turned(self, scale: float) -> bool:
        assert self.rotation_quaternion_xyzw is not None
        turned = zip(*rotation_columns(normal_quaternion(self.rotation_quaternion_xyzw)), strict=True)
        held = ([value / scale for value in row[:3]] for row in self.matrix[:3])
        return all(map(_close, turned, held))


def _close(a: Sequence[float], b: Sequence[float]) -> bool:
    return all(math.isclose(p, q, rel_tol=_AGREE, abs_tol=_AGREE) for p, q in zip(a, b, strict=True))


def _spelling(value: Any) -> str:
    return "transform_object" if isinstance(value, dict | TransformObject) else "matrix_rows"


Similarity = Annotated[
    Annotated[Matrix, Tag("matrix_rows")] | Annotated[TransformObject, Tag("transform_object")],
    Discriminator(_spelling),
]
SPELLINGS = frozenset({"matrix_rows", "transform_object", "object_pose"})


def rows_of(transform: Rows | TransformObject | ObjectPose) -> Rows:
    """The 4x4 of any spelling; of a pose its T_object_scene."""
    if isinstance(transform, ObjectPose):
        return transform.rows
    return transform.matrix if isinstance(transform, TransformObject) else transform


def _one_direction(schema: dict[str, Any]) -> None:
    # within allOf, as in RegisterRequest
    schema["allOf"] = [{"oneOf": [{"required": ["T_object_scene"]}, {"required": ["T_scene_object"]}]}]
    for name in ("T_object_scene", "T_scene_object"):
        schema["properties"][name].pop("default")


class ObjectPose(Incoming):
    """The object's pose, in one of two directions."""

    model_config = ConfigDict(json_schema_extra=_one_direction)

    T_object_scene: Similarity | None = Field(None, description="Scene coordinates to object coordinates.")
    T_scene_object: Similarity | None = Field(
        None, description="Object coordinates to scene coordinates, as in results."
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
        assert self.T_scene_object is not None, "give exactly one of them"
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


PRESET_FAULT = "preset_unsuitable"


class FieldReference(Incoming):
    """A field, identified by the SHA-256 of the uploaded file."""

    field: Sha256


def _bare_reference(value: Any) -> Any:
    return value["field"] if isinstance(value, dict) and value.keys() == {"field"} else value


Reference = Annotated[Sha256, BeforeValidator(_bare_reference, json_schema_input_type=Sha256 | FieldReference)]


def _given(value: Any) -> Any:
    if value is None:
        raise ValueError("leave it out, or give at least one")
    return value


def _distinct(names: list[str]) -> list[str]:
    if len(set(names)) < len(names):
        raise ValueError("a field is given twice")
    return names


Candidates = Annotated[
    list[Reference],
    Field(min_length=1, max_length=MAX_SELECTED, json_schema_extra={"uniqueItems": True}),
    AfterValidator(_distinct),
]
OneObject = Annotated[Annotated[Reference, Tag(BY_DIGEST)] | Named, Choice]
SeveralObjects = Annotated[Annotated[Candidates, Tag(BY_DIGEST)] | Selected, Choice]


class Webhook(Incoming):
    """Where to send a signed message once the job has ended."""

    url: Annotated[str, StringConstraints(min_length=8, max_length=2000)]


class RegistrationSpec(Incoming):
    """What a registration asks for, apart from the fields: the part `request` of a one-shot upload."""

    detection: AnyDetection = Field(
        description="Where in the scene the object is: a box. For a recording also a mask, box or point in its images."
    )
    options: RegistrationOptions = Field(default_factory=RegistrationOptions)
    seed: Annotated[int, Field(ge=0, le=2**32 - 1, description="The same seed gives the same result.")] = 0
    initial_transform: Start | None = Field(
        None,
        description="Initial guess. The full search runs only if the pose from the initial guess is rejected or "
        "has a probability below 0.95. A transform without a name is a T_object_scene. Only for the "
        "preset `robust`.",
    )
    ground_truth: ObjectPose | None = Field(
        None, description="The true pose. If it is given, the metrics have the errors."
    )
    webhook: Webhook | None = Field(
        None, description="Gets a message when the job ends, at once if it has ended. The service must allow the host."
    )

    pictures: StrictBool = Field(
        True,
        description="Whether the job makes diagnostic artifacts: point clouds, residuals and a picture. They take "
        "about a third of the time of a small registration. The numbers in the result are the same without them.",
    )

    @field_validator("initial_transform")
    @classmethod
    def _is_of_use(cls, start: Any, info: ValidationInfo) -> Any:
        options = info.data.get("options")  # absent when they were refused themselves
        if start is not None and options is not None and options.preset != "robust":
            raise PydanticCustomError(PRESET_FAULT, "only the preset `robust` can use an initial transform")
        return start

    def to_request(
        self, scene: str, object_: str | None, candidates: Sequence[str] | None = None
    ) -> RegistrationRequest:
        """The job's request: every default filled in, every spelling of a value made one.

        The order of candidates says nothing, so they are sorted.
        """
        start, truth, webhook = self.initial_transform, self.ground_truth, self.webhook
        return RegistrationRequest(
            scene=scene,
            object=object_,
            candidates=None if candidates is None else tuple(sorted(candidates)),
            detection=self.detection,
            options=self.options,
            seed=self.seed,
            initial_transform=None if start is None else rows_of(start),
            ground_truth=None if truth is None else truth.rows,
            webhook=None if webhook is None else webhook.url,
            pictures=self.pictures,
        )


def _one_of_both(schema: dict[str, Any]) -> None:
    # within allOf: of a bare oneOf with nothing but `required` in it, generators of clients make Any
    schema["allOf"] = [{"oneOf": [{"required": ["object"]}, {"required": ["candidates"]}]}]
    for name in ("object", "candidates"):
        schema["properties"][name].pop("default")  # null is what leaving it out means, nothing to send


def _nothing_needed(schema: dict[str, Any]) -> None:
    for name in ("object", "candidates"):
        schema["properties"][name].pop("default")
    del schema["properties"]["scene"]


class RegisterRequest(RegistrationSpec):
    """One registration: the scene, the detection in it, and the object, or the candidates to choose from."""

    model_config = ConfigDict(json_schema_extra=_one_of_both)

    scene: Reference = Field(description="The scene's field.")
    object: Annotated[
        OneObject | None, BeforeValidator(_given, json_schema_input_type=Sha256 | FieldReference | LibraryReference)
    ] = Field(None, description="The object's field, or its entry in the library.")
    candidates: Annotated[
        SeveralObjects | None, BeforeValidator(_given, json_schema_input_type=Candidates | LibrarySelection)
    ] = Field(
        None,
        description="Instead of `object`: fields, or entries of the library. The preset `robust` registers the "
        "most probable one. The result ranks the candidates.",
    )

    @field_validator("candidates")
    @classmethod
    def _can_be_searched(cls, names: Any, info: ValidationInfo) -> Any:
        if names is None:
            return None
        options = info.data.get("options")
        if options is not None and options.preset != "robust":
            raise PydanticCustomError(PRESET_FAULT, "only the preset `robust` searches a library")
        if info.data.get("initial_transform") is not None:
            raise PydanticCustomError(PRESET_FAULT, "a search of a library cannot use an initial transform")
        if info.data.get("ground_truth") is not None:
            raise ValueError("a ground truth applies to one object, not to several candidates")
        return names

    @model_validator(mode="after")
    def _asks_for_one_or_several(self) -> RegisterRequest:
        if (self.object is None) == (self.candidates is None):
            raise ValueError("exactly one of `object` and `candidates` must be given")
        return self


class OneShotRequest(RegisterRequest):
    """The part `request` of a registration that is sent together with its scene, and optionally its object."""

    model_config = ConfigDict(json_schema_extra=_nothing_needed)

    scene: None = None  # type: ignore[assignment]
    detection: AnyDetection | None = Field(  # type: ignore[assignment]
        None, description="Where in the scene the object is. For a frame, the part `mask` can be used instead."
    )

    @model_validator(mode="after")
    def _asks_for_one_or_several(self) -> OneShotRequest:
        if self.object is not None and self.candidates is not None:
            raise ValueError("at most one of `object` and `candidates` is given")
        return self


class DryRunDocument(Outgoing):
    """The response to `?dry_run=true`: the request would be accepted, and these would be its values."""

    valid: bool
    id: str
    request: dict[str, Any]
