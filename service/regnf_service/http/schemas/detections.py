"""The detection of a request: read by the core's parser, shown in the contract in all the forms that it takes."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import ConfigDict, Field, PlainSerializer, PlainValidator
from pydantic.json_schema import SkipJsonSchema
from pydantic_core import PydanticCustomError

from regnf_core.detections import Detection as ParsedDetection
from regnf_core.detections import parse_detection
from regnf_core.errors import InvalidDetectionError
from regnf_service.http.schemas.results import Coordinate, Incoming, Label

DETECTION_FAULT = "invalid_detection"
"""The type of a fault whose context says the place within the detection, the message and the hint."""
_Edge = Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)]
_Component = Annotated[float, Field(ge=-1e3, le=1e3, allow_inf_nan=False)]
_Row = Annotated[list[_Component], Field(min_length=3, max_length=3)]
_List = Annotated[list[Coordinate], Field(min_length=3, max_length=3)]
_Four = Annotated[list[_Component], Field(min_length=4, max_length=4)]
_Nothing = SkipJsonSchema[None]
_IGNORED = Field(None, description="Of Open3D; ignored beside its names of the box's members.")


class Point(Incoming):
    """A point by its coordinates' names."""

    x: Coordinate
    y: Coordinate
    z: Coordinate


class Quaternion(Incoming):
    """A quaternion by its components' names, as ROS has it."""

    x: _Component
    y: _Component
    z: _Component
    w: _Component


class Edges(Incoming):
    """Full edge lengths by their axes' names."""

    x: _Edge
    y: _Edge
    z: _Edge


_Point = _List | Point
_Size = Annotated[list[_Edge], Field(min_length=3, max_length=3)] | Edges
_Matrix = Annotated[
    list[_Row], Field(min_length=3, max_length=3, description="Rows; the columns are the box's axes in the scene.")
]
_Rotation = _Matrix | Quaternion


class _Labeled(Incoming):
    label: Label | None = Field(None, description="What the detector took it for. Not used by the registration.")
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
    """A box by center, full edge lengths and rotation, which is the identity when left out. Open3D's
    OrientedBoundingBox, with `extent` and `R`, is taken as it is."""

    model_config = _one_of_each(("center",), ("size", "extent"))

    center: _Point | _Nothing = None
    size: _Size | _Nothing = None
    extent: _Size | _Nothing = None
    rotation_quaternion_xyzw: _Four | Quaternion | _Nothing = None
    rotation_quaternion_wxyz: _Four | Quaternion | _Nothing = None
    rotation: _Rotation | _Nothing = Field(
        None, description="Box axes to scene axes. Four bare numbers are refused: they do not say their order."
    )
    R: _Rotation | _Nothing = None


class CornerBox(_OfOpen3D):
    """An axis-aligned box by its lowest and its highest corner. `min_bound` and `max_bound` are Open3D's names."""

    model_config = _one_of_each(("min", "min_bound"), ("max", "max_bound"))

    min: _Point | _Nothing = None
    min_bound: _Point | _Nothing = None
    max: _Point | _Nothing = None
    max_bound: _Point | _Nothing = None


_Corners = Annotated[
    list[_Point],
    Field(min_length=2, max_length=2, description="Lowest and highest corner of an axis-aligned box."),
]


def _read(value: Any) -> ParsedDetection:
    try:
        return parse_detection(value).normal()
    except InvalidDetectionError as error:
        context = {"message": str(error), "hint": error.hint, "place": list(error.place)}
        raise PydanticCustomError(DETECTION_FAULT, "{message}", context) from error


Detection = Annotated[
    ParsedDetection,
    PlainValidator(_read, json_schema_input_type=CornerBox | CenteredBox | _Corners),
    PlainSerializer(ParsedDetection.values, return_type=dict[str, Any]),
]
