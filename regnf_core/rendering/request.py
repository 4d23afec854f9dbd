"""What is to be rendered, in plain (JSON) values: edits, cameras, size, options, files. Torch-free."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal

from annotated_types import Ge, Gt, Le, Len
from pydantic import FiniteFloat, TypeAdapter, ValidationError

from regnf_core.editing.request import AnyEdit, Axis, Box, Rows, read_edits
from regnf_core.errors import InvalidInputError, InvalidOptionsError
from regnf_core.rendering.options import MOST_FRAMES, RenderOptions, check_extent

_CONFIG: dict[str, Any] = {"extra": "forbid"}
_Point = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
_Angle = Annotated[FiniteFloat, Gt(0), Le(170)]
_Count = Annotated[int, Ge(1)]
_UNIT = 5e-5
"""How far a rotation's axes may be from unit length."""
_Length = Annotated[FiniteFloat, Gt(0), Le(1e9)]
Output = Literal["color", "depth", "normal", "animation", "strip", "mesh", "field"]
"""color, depth, normal: a file a frame · animation: animated WebP · strip: before and after, side by side · mesh:
composite.glb · field: the edited scene as a field file."""


@dataclass(frozen=True)
class OrbitRequest:
    """Cameras round one thing. edit: the number of an edit, whose object is looked at · detection: a box instead;
    neither: the first edit, or without edits the scene's bounds. The rest: regnf_core.rendering.paths.Orbit."""

    __pydantic_config__: ClassVar[dict[str, Any]] = _CONFIG

    edit: Annotated[int, Ge(0)] | None = None
    detection: Box = None
    frames: _Count = 8
    elevation_deg: Annotated[FiniteFloat, Ge(-89.9), Le(89.9)] = 25.0
    start_deg: FiniteFloat = 0.0
    sweep_deg: FiniteFloat = 360.0
    distance: _Length | None = None
    field_of_view_deg: _Angle = 50.0
    up: Axis = "z"


@dataclass(frozen=True)
class StationRequest:
    """One place to look from. position, target: scene frame."""

    __pydantic_config__: ClassVar[dict[str, Any]] = _CONFIG

    position: _Point
    target: _Point
    field_of_view_deg: _Angle = 50.0
    up: Axis | _Point = "z"

    def __post_init__(self) -> None:
        if self.position == self.target:
            raise ValueError("position and target are the same point")


@dataclass(frozen=True)
class PoseRequest:
    """A camera whose pose and lens are known. T_scene_camera: rotation and place, OpenCV's axes (x right, y down, z
    forward) · intrinsics: fx, fy, cx, cy in pixels of an image of ``size`` (width, height)."""

    __pydantic_config__: ClassVar[dict[str, Any]] = _CONFIG

    T_scene_camera: Rows
    intrinsics: Annotated[list[FiniteFloat], Len(4, 4)]
    size: tuple[_Count, _Count]

    def __post_init__(self) -> None:
        if min(self.intrinsics[:2]) <= 0:
            raise ValueError("focal lengths are above 0")
        if abs(math.hypot(*(row[0] for row in self.T_scene_camera[:3])) - 1.0) > _UNIT:
            raise ValueError("T_scene_camera has a scale, and a camera has none")


@dataclass(frozen=True)
class RenderRequest:
    """One rendering of a scene. Exactly one of orbit, look_at and poses; none: an orbit as it is by default.

    size: width and height of every frame; None: 480 x 360, or what a pose says · before: the scene without its edits
    is rendered too (files named before-...), as a strip and an animation need it.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = _CONFIG

    edits: list[AnyEdit] = field(default_factory=list)
    orbit: OrbitRequest | None = None
    look_at: Annotated[list[StationRequest], Len(1)] | None = None
    poses: Annotated[list[PoseRequest], Len(1)] | None = None
    size: tuple[_Count, _Count] | None = None
    options: RenderOptions = field(default_factory=RenderOptions)
    outputs: list[Output] = field(default_factory=lambda: ["color", "depth", "normal", "strip"])
    before: bool = True
    clear_unseen: bool = False
    """Leave out the scene's matter where nothing was measured, where the scene knows that: fields invent it behind
    things, and it hides them from there."""
    mesh_resolution: Annotated[int, Ge(2), Le(1024)] = 192
    """Cells along the longest edge of the bounds, for ``mesh``."""
    field_resolution: Annotated[int, Ge(2), Le(1024)] = 192
    """The same for ``field``."""
    seed: Annotated[int, Ge(0), Le(2**32 - 1)] = 0

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> RenderRequest:
        """From plain values, all checked. Raises InvalidInputError naming the member: INVALID_OPTIONS, CAMERA_INVALID,
        EDIT_INVALID, INVALID_TRANSFORM, INVALID_DETECTION, RENDER_TOO_LARGE."""
        if not isinstance(values, dict):
            raise InvalidOptionsError("a rendering is described by an object")
        read_edits(values.get("edits", []))  # its own reasons
        try:
            request: RenderRequest = _ADAPTER.validate_python(values)
        except ValidationError as error:
            raise _fault(error) from error
        request.check()
        return request

    @property
    def frames(self) -> int:
        """How many there are, of the edited scene."""
        if self.look_at is not None:
            return len(self.look_at)
        if self.poses is not None:
            return len(self.poses)
        return (self.orbit or OrbitRequest()).frames

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height of every frame."""
        if self.size is not None:
            return self.size
        return self.poses[0].size if self.poses else (480, 360)

    def check(self) -> None:
        """Raises InvalidInputError: CAMERA_INVALID, RENDER_TOO_LARGE."""
        if sum(one is not None for one in (self.orbit, self.look_at, self.poses)) > 1:
            message = "cameras: say one of orbit, look_at and poses"
            raise InvalidInputError(message, reason="CAMERA_INVALID")
        edit = self.orbit.edit if self.orbit is not None else None
        if edit is not None and edit >= len(self.edits):
            raise InvalidInputError(f"orbit.edit: there is no edit {edit}", reason="CAMERA_INVALID")
        width, height = self.image_size
        check_extent(self.frames, width * height)

    @property
    def rendered_pixels(self) -> int:
        """Rays to be cast in all, those of the scene before its edits included: the cost of the work, about."""
        width, height = self.image_size
        times = 2 if self.before and self.edits else 1
        return times * self.frames * width * height * self.options.antialias**2


def _fault(error: ValidationError) -> InvalidInputError:
    first = error.errors(include_url=False, include_input=False)[0]
    where = ".".join(str(part) for part in first["loc"])
    message = f"{where}: {first['msg'].removeprefix('Value error, ')}"
    if where.split(".")[0] in ("orbit", "look_at", "poses", "size"):
        return InvalidInputError(message, reason="CAMERA_INVALID")
    return InvalidOptionsError(message)


_ADAPTER = TypeAdapter(RenderRequest)
__all__ = ["MOST_FRAMES", "OrbitRequest", "PoseRequest", "RenderRequest", "StationRequest"]
