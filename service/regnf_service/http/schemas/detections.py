"""The detection of a request: read by the core's parser, shown in the contract in all the forms that it takes."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import ConfigDict, Field, PlainSerializer, PlainValidator
from pydantic.json_schema import SkipJsonSchema
from pydantic_core import PydanticCustomError

from regnf_core.detections import Detection as ParsedDetection
from regnf_core.detections import parse_detection
from regnf_core.detections.images import AnyDetection as BoxOrImages
from regnf_core.detections.images import ImageDetection, is_image_detection, read_image_detections
from regnf_core.errors import InvalidDetectionError
from regnf_service.http.schemas.results import Coordinate, Incoming, Label
from regnf_state.registration_request import values_of

DETECTION_FAULT = "invalid_detection"
"""The type of a fault whose context says the place within the detection, the message and the hint."""
_Edge = Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)]
_Component = Annotated[float, Field(ge=-1e3, le=1e3, allow_inf_nan=False)]
_Row = Annotated[list[_Component], Field(min_length=3, max_length=3)]
_List = Annotated[list[Coordinate], Field(min_length=3, max_length=3)]
_Four = Annotated[list[_Component], Field(min_length=4, max_length=4)]
_Nothing = SkipJsonSchema[None]
_IGNORED = Field(None, description="A member of Open3D's boxes. It is ignored.")


class Point(Incoming):
    """A point, given by the names of its coordinates."""

    x: Coordinate
    y: Coordinate
    z: Coordinate


class Quaternion(Incoming):
    """A quaternion, given by the names of its components, as in ROS."""

    x: _Component
    y: _Component
    z: _Component
    w: _Component


class Edges(Incoming):
    """Full edge lengths, by the names of the axes."""

    x: _Edge
    y: _Edge
    z: _Edge


_Point = _List | Point
_Size = Annotated[list[_Edge], Field(min_length=3, max_length=3)] | Edges
_Matrix = Annotated[
    list[_Row],
    Field(min_length=3, max_length=3, description="Rows of the matrix. Its columns are the box's axes in the scene."),
]
_Rotation = _Matrix | Quaternion


class _Labeled(Incoming):
    label: Label | None = Field(None, description="The detector's class. The registration does not use it.")
    score: Annotated[float, Field(ge=0, le=1)] | None = Field(None, description="The detector's confidence.")


class _OfOpen3D(_Labeled):
    color: Any = _IGNORED
    class_name: Any = _IGNORED
    version_major: Any = _IGNORED
    version_minor: Any = _IGNORED


def _one_of_each(*groups: tuple[str, ...]) -> ConfigDict:
    """A schema that requires one name of each group; what may be left out has no default to show."""

    def change(schema: dict[str, Any]) -> None:
        schema["allOf"] = [{"oneOf": [{"required": [name]} for name in group]} for group in groups]
        for name, member in schema["properties"].items():
            if name not in ("label", "score"):
                member.pop("default", None)

    return ConfigDict(json_schema_extra=change)


class CenteredBox(_OfOpen3D):
    """A box given by its center, full edge lengths and rotation (default: identity). Open3D's OrientedBoundingBox, with
    `extent` and `R`, is accepted unchanged."""

    model_config = _one_of_each(("center",), ("size", "extent"))

    center: _Point | _Nothing = None
    size: _Size | _Nothing = None
    extent: _Size | _Nothing = None
    rotation_quaternion_xyzw: _Four | Quaternion | _Nothing = None
    rotation_quaternion_wxyz: _Four | Quaternion | _Nothing = None
    rotation: _Rotation | _Nothing = Field(
        None,
        description="Rotates box axes to scene axes. Four numbers without a name are refused, because their order "
        "is unknown.",
    )
    R: _Rotation | _Nothing = None


class CornerBox(_OfOpen3D):
    """An axis-aligned box given by its lowest and its highest corner. `min_bound` and `max_bound` are Open3D's
    names."""

    model_config = _one_of_each(("min", "min_bound"), ("max", "max_bound"))

    min: _Point | _Nothing = None
    min_bound: _Point | _Nothing = None
    max: _Point | _Nothing = None
    max_bound: _Point | _Nothing = None


_Corners = Annotated[
    list[_Point],
    Field(
        min_length=2,
        max_length=2,
        description="Lowest and highest corner of an axis-aligned box. "
        "Refused if all numbers of the second are positive: they may be a size.",
    ),
]


_Pixels = Annotated[float, Field(allow_inf_nan=False)]


class InImage(_Labeled):
    """An object in one image of a recording, in pixels of the color image. Without a color image, in pixels of the
    depth image."""

    model_config = _one_of_each(("mask", "box_2d", "point_2d"))

    frame: str | int = Field(0, description="The name of the frame, or its number.")
    mask: str | dict[str, Any] | list[list[_Pixels]] | _Nothing = Field(
        None,
        description="A PNG of the image's size as base64, not 0 on the object; or COCO's run-length encoding, "
        "`size` (height, width) and `counts`; or COCO's polygons.",
    )
    box_2d: Annotated[list[_Pixels], Field(min_length=4, max_length=4, description="Left, top, right, bottom.")] | (
        _Nothing
    ) = None
    point_2d: Annotated[list[_Pixels], Field(min_length=2, max_length=2, description="Column, row.")] | _Nothing = None


MOST_IMAGES = 32
"""Detections of one object, each in an image of its own."""
_MOST_NAME = 200
_PNG = "iVBORw0KGgo"
"""How one begins as base64."""


def read_images(value: Any) -> tuple[ImageDetection, ...]:
    """An object in images, as requests have it. Raises InvalidDetectionError."""
    if isinstance(value, list) and len(value) > MOST_IMAGES:
        hint = "Give the images that show most of the object."
        raise InvalidDetectionError(f"has {len(value)} entries, expected {MOST_IMAGES} at most", hint=hint)
    found = read_image_detections(value)
    for one in found:
        if max(len(str(one.frame)), len(one.label or "")) > _MOST_NAME:
            raise InvalidDetectionError(f"the frame's name and the label can have at most {_MOST_NAME} characters")
        if isinstance(one.mask, str) and not (one.mask.partition("base64,")[2] or one.mask).startswith(_PNG):
            hint = "Write the bytes of a PNG of the image's size as base64, or COCO's run-length encoding."
            raise InvalidDetectionError("the mask is not a PNG as base64", hint=hint, place=("mask",))
    return found


def _read_any(value: Any) -> BoxOrImages:
    if not is_image_detection(value):
        return _read(value)
    try:
        return read_images(value)
    except InvalidDetectionError as error:
        raise _fault(error) from error


def _fault(error: InvalidDetectionError) -> PydanticCustomError:
    context = {"message": str(error), "hint": error.hint, "place": list(error.place)}
    return PydanticCustomError(DETECTION_FAULT, "{message}", context)


def _read(value: Any) -> ParsedDetection:
    try:
        return parse_detection(value).normal()
    except InvalidDetectionError as error:
        raise _fault(error) from error


Detection = Annotated[
    ParsedDetection,
    PlainValidator(_read, json_schema_input_type=CornerBox | CenteredBox | _Corners),
    PlainSerializer(ParsedDetection.values, return_type=dict[str, Any]),
]
AnyDetection = Annotated[
    BoxOrImages,
    PlainValidator(
        _read_any,
        json_schema_input_type=CornerBox
        | CenteredBox
        | _Corners
        | InImage
        | Annotated[list[InImage], Field(min_length=1, max_length=MOST_IMAGES)],
    ),
    PlainSerializer(values_of, return_type=Any),
]
"""The same of a scene that may be a recording: a box, or the object in its images."""
