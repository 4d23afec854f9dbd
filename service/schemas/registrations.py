"""What POST /register takes."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BeforeValidator, Field, ValidationInfo, field_validator
from pydantic_core import PydanticCustomError

from regnf_core.options import RegistrationOptions
from service.schemas.common import Incoming, Outgoing, Sha256
from service.schemas.detections import Detection
from service.schemas.transforms import Similarity

START_UNSUPPORTED = "initial_transform_unsupported"


class FieldReference(Incoming):
    """A field by the SHA-256 of the bytes that were uploaded."""

    field: Sha256


def _bare_reference(value: Any) -> Any:
    return value["field"] if isinstance(value, dict) and value.keys() == {"field"} else value


Reference = Annotated[Sha256, BeforeValidator(_bare_reference, json_schema_input_type=Sha256 | FieldReference)]


class GroundTruth(Incoming):
    """The known transform, scene coordinates to object coordinates; the result's metrics then hold the errors."""

    T_object_scene: Similarity


class Question(Incoming):
    """What a registration asks, apart from the fields: the part `request` of a one-shot upload."""

    detection: Detection = Field(description="Where in the scene the object is.")
    options: RegistrationOptions = Field(default_factory=RegistrationOptions)
    seed: Annotated[int, Field(ge=0, le=2**32 - 1, description="The same seed gives the same result.")] = 0
    initial_transform: Similarity | None = Field(
        None,
        description="A T_object_scene to look at first; everything else is searched only if that is rejected. "
        "For the preset `robust`.",
    )
    ground_truth: GroundTruth | None = None

    @field_validator("initial_transform")
    @classmethod
    def _is_of_use(cls, start: Any, info: ValidationInfo) -> Any:
        options = info.data.get("options")  # absent when they were refused themselves
        if start is not None and options is not None and options.preset != "robust":
            raise PydanticCustomError(START_UNSUPPORTED, "only the preset `robust` starts from a given transform")
        return start


class RegisterRequest(Question):
    """One registration: which scene, where in it, and which object to lay onto it."""

    scene: Reference = Field(description="The scene's field.")
    object: Reference = Field(description="The library object's field.")


class DryRunDocument(Outgoing):
    """The answer to `?dry_run=true`: the request would be accepted, and this is what it would become."""

    valid: bool
    id: str
    request: dict[str, Any]
