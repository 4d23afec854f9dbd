"""What is to be rendered, in plain (JSON) values: edits, cameras, size, options, files. Torch-free."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal

from annotated_types import Ge, Gt, Le, Len
from pydantic import FiniteFloat, TypeAdapter, ValidationError

from regnf_core.cost import Cost, Option, Term
from regnf_core.editing.request import AnyEdit, Axis, Box, Rows, read_edits
from regnf_core.errors import InvalidInputError, InvalidOptionsError
from regnf_core.rgb import Rgb
from regnf_core.schema.closed import Closed

# What may be chosen of a rendering: plain data, without torch.

MOST_PIXELS = 1 << 24
"""Of one frame."""
MOST_FRAMES = 2000
MOST_PIXELS_IN_ALL = 1 << 30


@dataclass(frozen=True)
class RenderOptions:
    """Options of a rendering. They apply to all frames."""

    __pydantic_config__: ClassVar[dict[str, Any]] = {"extra": "forbid", "use_attribute_docstrings": True}

    mode: Literal["surface", "volume"] = "surface"
    """surface: the first intersection of each ray with the zero level. volume: NeuS's opacity along the ray; it shows
    how sharp a field is, and takes three to four times as long."""
    coloring: Literal["auto", "field", "shaded"] = "auto"
    """auto: the field's colors if it has colors, else shading. field: the field's colors, or an error if it has none.
    shaded: always shading."""
    tints: bool = True
    """Whether edited objects are tinted."""
    antialias: Annotated[int, Ge(1), Le(4)] = 1
    """Rays along each side of a pixel, for colors, normals and opacity. Depths are those at the center of the pixel, or
    next to it."""
    background: Rgb = (1.0, 1.0, 1.0)
    """Color of a pixel whose ray hits no surface."""
    up: Literal["x", "y", "z", "-x", "-y", "-z"] = "z"
    """Direction of the light for shading, scene frame."""
    cut_away: bool = False
    """Whether a camera may be inside solid matter: its rays then start where they leave it. Cameras of an orbit always
    may. For cameras outside of the bounds, matter at the bounds is always cut away."""
    inverse_deviation: Annotated[FiniteFloat, Gt(0), Le(1e9)] | None = None
    """NeuS's parameter s, per scene unit, for the mode volume. null: the learned value of the field, else 2000 divided
    by the diagonal of its bounds."""
    memory_mb: Annotated[int, Ge(16), Le(65536)] = 256
    """Approximate memory for the rays of one tile, MB. It limits the size of tiles and does not change the picture."""

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> RenderOptions:
        """From plain (JSON) values. Raises InvalidOptionsError for the first invalid one."""
        try:
            return _OPTIONS_ADAPTER.validate_python(values)
        except ValidationError as error:
            raise InvalidOptionsError(_first_of(error, "options")[1]) from error


def _first_of(error: ValidationError, *within: str) -> tuple[str, str]:
    """The first faulty member, and what is said of it."""
    first = error.errors(include_url=False, include_input=False)[0]
    where = ".".join(str(part) for part in (*within, *first["loc"]))
    return where, f"{where}: {first['msg'].removeprefix('Value error, ')}"


_OPTIONS_ADAPTER = TypeAdapter(RenderOptions)


def check_extent(frames: int, pixels: int) -> None:
    """Raises InvalidInputError (RENDER_TOO_LARGE): too many frames, or too many pixels in one (all of one size)."""
    for count, most, of in (
        (frames, MOST_FRAMES, "frames"),
        (pixels, MOST_PIXELS, "pixels in a frame"),
        (frames * pixels, MOST_PIXELS_IN_ALL, "pixels in all frames"),
    ):
        if count > most:
            message = f"{count} {of}; one rendering can have at most {most}"
            raise InvalidInputError(message, reason="RENDER_TOO_LARGE", hint="Request fewer or smaller frames.")


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
class OrbitRequest(Closed):
    """Cameras round one thing. edit: the number of an edit, whose object is looked at · detection: a box instead;
    neither: the first edit, or without edits the scene's bounds · elevation_deg: above the horizon · start_deg,
    sweep_deg: the first camera's turn about the vertical, and how far the last one is turned from it · distance: from
    the instance's middle, scene units; None: all of it is in view."""

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
class StationRequest(Closed):
    """One camera. `position` and `target` are in the scene frame."""

    position: _Point
    target: _Point
    field_of_view_deg: _Angle = 50.0
    up: Axis | _Point = "z"

    def __post_init__(self) -> None:
        if self.position == self.target:
            raise ValueError("position and target are the same point")


@dataclass(frozen=True)
class PoseRequest(Closed):
    """A camera with known pose and intrinsics. T_scene_camera: rotation and position, OpenCV's axes (x right, y down, z
    forward) · intrinsics: fx, fy, cx, cy in pixels of an image of ``size`` (width, height)."""

    T_scene_camera: Rows
    intrinsics: Annotated[list[FiniteFloat], Len(4, 4)]
    size: tuple[_Count, _Count]

    def __post_init__(self) -> None:
        if min(self.intrinsics[:2]) <= 0:
            raise ValueError("focal lengths must be above 0")
        if abs(math.hypot(*(row[0] for row in self.T_scene_camera[:3])) - 1.0) > _UNIT:
            raise ValueError("T_scene_camera must not have a scale")


@dataclass(frozen=True)
class RenderRequest(Closed):
    """One rendering of a scene. Exactly one of orbit, look_at and poses; none: an orbit as it is by default.

    size: width and height of every frame; None: 480 x 360, or what a pose says · before: the scene without its edits
    is rendered too (files named before-...), as a strip and an animation need it.
    """

    edits: list[AnyEdit] = field(default_factory=list)
    orbit: OrbitRequest | None = None
    look_at: Annotated[list[StationRequest], Len(1)] | None = None
    poses: Annotated[list[PoseRequest], Len(1)] | None = None
    size: tuple[_Count, _Count] | None = None
    options: RenderOptions = field(default_factory=RenderOptions)
    outputs: list[Output] = field(default_factory=lambda: ["color", "depth", "normal", "strip"])
    before: bool = True
    clear_unseen: bool = False
    """Whether unobserved matter of the scene is removed, if the scene has an observation. Networks invent such matter
    behind objects, and it hides them from behind."""
    mesh_resolution: Annotated[int, Ge(2), Le(1024)] = 192
    """Number of cells along the longest edge of the bounds, for ``mesh``."""
    field_resolution: Annotated[int, Ge(2), Le(1024)] = 192
    """Number of cells along the longest edge of the bounds, for ``field``."""
    seed: Annotated[int, Ge(0), Le(2**32 - 1)] = 0

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> RenderRequest:
        """From plain values, all checked. Raises InvalidInputError naming the member: INVALID_OPTIONS, CAMERA_INVALID,
        EDIT_INVALID, INVALID_TRANSFORM, INVALID_DETECTION, RENDER_TOO_LARGE."""
        if not isinstance(values, dict):
            raise InvalidOptionsError("a rendering request must be an object")
        read_edits(values.get("edits", []))  # its own reasons
        try:
            request: RenderRequest = _ADAPTER.validate_python(values)
        except ValidationError as error:
            where, message = _first_of(error)
            if where.split(".")[0] in ("orbit", "look_at", "poses", "size"):
                raise InvalidInputError(message, reason="CAMERA_INVALID") from error
            raise InvalidOptionsError(message) from error
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
            raise InvalidInputError("cameras: give one of orbit, look_at and poses", reason="CAMERA_INVALID")
        edit = self.orbit.edit if self.orbit is not None else None
        if edit is not None and edit >= len(self.edits):
            raise InvalidInputError(f"orbit.edit: there is no edit {edit}", reason="CAMERA_INVALID")
        width, height = self.image_size
        check_extent(self.frames, width * height)

    @property
    def rendered_pixels(self) -> int:
        """Rays to be cast in all, those of the scene before its edits included: the cost of the work, about."""
        return self.pixels_in_all * self.options.antialias**2

    @property
    def pixels_in_all(self) -> int:
        """Of all frames, those of the scene before its edits included."""
        width, height = self.image_size
        return (2 if self.before and self.edits else 1) * self.frames * width * height


_ADAPTER = TypeAdapter(RenderRequest)


# What a rendering costs at most, estimated from its request alone: memory, seconds, and bytes of files. Torch-free.
#
# Upper ends for memory and files. Seconds are of one core and right within a factor of ten: the fields decide.

_RAY_S = {"surface": 50e-6, "volume": 200e-6}
_RAY_BYTES = 4000
_PIXEL_BYTES = 100
"""Of the frame that is being rendered: all that is known at a pixel, and its pictures."""
_KEPT_BYTES = 20
"""Of each pixel of an animation, which is written once all frames are there."""
_NODE_BYTES, _NODE_S = 12, 3e-6
"""Of a node of a lattice that a field is evaluated on."""
_EDIT_S = 5.0
_FILE_BYTES = {"color": 3, "depth": 2 + 4, "normal": 3, "animation": 1}
"""Of each pixel: PNG of bytes that nothing compresses; depth also as .npy."""
_MESH_FILE_BYTES = 200
"""Of each cell that the surface passes through."""
_SIZE: tuple[Option, ...] = (("size",),)


@dataclass(frozen=True)
class RenderCost(Cost):
    """The estimated cost of one rendering. file_bytes: of all that it writes."""

    file_bytes: int


def estimate(request: RenderRequest) -> RenderCost:
    """The cost of a request whose extent has been checked."""
    width, height = request.image_size
    pixels, options = width * height, request.options
    cameras: Option = ("poses",) if request.poses is not None else ("orbit", "frames")
    cameras = ("look_at",) if request.look_at is not None else cameras
    tile = min(options.memory_mb * 1_000_000, pixels * _RAY_BYTES)
    rays = request.rendered_pixels
    where = *_SIZE, cameras, ("options", "antialias")
    terms = [
        Term("rays", rays, where, 0, rays * _RAY_S[options.mode]),
        Term("pixels of a frame", pixels, _SIZE, tile + pixels * _PIXEL_BYTES, 0.0),
        Term("edits", len(request.edits), (("edits",),), 0, len(request.edits) * _EDIT_S),
    ]
    if "animation" in request.outputs:
        kept = request.pixels_in_all
        terms.append(Term("pixels of the animation", kept, (*_SIZE, cameras), kept * _KEPT_BYTES, 0.0))
    for output in ("mesh", "field"):
        if output in request.outputs:
            nodes = (getattr(request, f"{output}_resolution") + 1) ** 3
            where_ = ((f"{output}_resolution",),)
            terms.append(Term(f"nodes of the {output}", nodes, where_, nodes * _NODE_BYTES, nodes * _NODE_S))
    total = request.pixels_in_all * sum(_FILE_BYTES.get(output, 0) for output in request.outputs)
    if "mesh" in request.outputs:
        total += 6 * request.mesh_resolution**2 * _MESH_FILE_BYTES
    if "field" in request.outputs:
        total += 4 * (request.field_resolution + 1) ** 3
    return RenderCost(tuple(terms), total)


# Which revision of the renderer this is: raised by hand whenever the same request gives other files.

RENDERER_REVISION = 3
