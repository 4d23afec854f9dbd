"""The edits of POST /render: each names a finished registration, or an object and its transform."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Discriminator, Field, StringConstraints, model_validator

from regnf_core.document import ArtifactEntry, Outgoing
from regnf_core.editing.request import MOST_EDITS, Axis, Name, Residual
from regnf_core.rendering.request import OrbitRequest, Output, PoseRequest, RenderOptions, RenderRequest, StationRequest
from regnf_core.rgb import Rgb
from regnf_service.http.schemas.detections import Detection
from regnf_service.http.schemas.registrations import Reference, Similarity, Webhook, rows_of
from regnf_service.http.schemas.results import Incoming

KINDS = frozenset({"substitution", "replacement", "removal", "insertion"})
_JobId = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_-]{1,64}$")]
_EITHER = "an edit has either `job`, or `object` and `T_object_scene`"


class _Edit(Incoming):
    name: Name | None = Field(None, description="A comment.")

    def plain(self) -> dict[str, Any]:
        """The members that were given, as plain values; a transform as its rows."""
        values = self.model_dump(mode="json", exclude_none=True)
        for member in ("T_object_scene", "T_replacement_object"):
            given = getattr(self, member, None)
            if given is not None:
                values[member] = rows_of(given)
        return values


def _without_nulls(schema: dict[str, Any]) -> None:
    """What is left out has no default to show."""
    for name in ("job", "object", "T_object_scene", "detection"):
        if name in schema["properties"]:
            schema["properties"][name].pop("default", None)


class _OfObject(_Edit):
    model_config = ConfigDict(json_schema_extra=_without_nulls)

    job: _JobId | None = Field(
        None, description="A finished registration in this scene. Its object is used, at its pose."
    )
    object: Reference | None = Field(None, description="Instead of `job`: the field of the object in the scene.")
    T_object_scene: Similarity | None = Field(None, description="With `object`: scene to object coordinates.")
    residual: Residual | None = Field(
        None,
        description="Distance between the surfaces of object and scene, object units. Default: that of the job's "
        "result.",
    )

    def named(self) -> bool:
        """Whether an object is named at all. Raises ValueError for half of a name, or for two."""
        pair = (self.object is not None, self.T_object_scene is not None)
        if pair[0] != pair[1] or (self.job is not None and pair[0]):
            raise ValueError(_EITHER)
        return self.job is not None or pair[0]


class _OfNamedObject(_OfObject):
    @model_validator(mode="after")
    def _names_its_object(self) -> _OfNamedObject:
        if not self.named():
            raise ValueError(_EITHER)
        return self


class Substitution(_OfNamedObject):
    """Substitutes the object's own field for the object in the scene."""

    kind: Literal["substitution"]
    tint: Rgb | None = Field(None, description="sRGB, 0 to 1: color of its surface.")


class Replacement(_OfNamedObject):
    """Replaces a registered object by another object."""

    kind: Literal["replacement"]
    replacement: Reference = Field(description="The field of the new object.")
    T_replacement_object: Similarity | None = Field(
        None, description="From the object's coordinates to the replacement's. Default: same base, same size."
    )
    match: Literal["height", "diagonal"] = "height"
    up_object: Axis = "z"
    up_replacement: Axis = "z"
    tint: Rgb | None = None


class Removal(_OfObject):
    """Removes the content of a box or a registered object. Floor and walls are continued there."""

    kind: Literal["removal"]
    detection: Detection | None = Field(None, description="A box in the scene around the whole object.")

    @model_validator(mode="after")
    def _names_something(self) -> Removal:
        if not self.named() and self.detection is None:
            raise ValueError("a removal needs `detection`, `job`, or `object` and `T_object_scene`")
        return self


class Insertion(_Edit):
    """Adds an object. Nothing of the scene is removed."""

    kind: Literal["insertion"]
    object: Reference
    T_object_scene: Similarity = Field(description="Scene to object coordinates: any similarity transform.")
    tint: Rgb | None = None


Edit = Annotated[Substitution | Replacement | Removal | Insertion, Discriminator("kind")]


# What POST /render takes, and the result of such a job.

MOST_CAMERAS = 256
"""That a request lists: its record is held until the job ends."""
_Count = Annotated[int, Field(ge=1)]
_Resolution = Annotated[
    int, Field(ge=2, le=1024, description="Number of cells along the longest edge of the scene's bounds.")
]


@dataclass(frozen=True)
class Orbit(OrbitRequest):
    """Cameras on an orbit around the object of the edit with this number, or around a box. Default: around the object
    of the first edit, or without edits around the whole scene."""

    detection: Detection | None = None


class CameraFile(Incoming):
    """The cameras of a transforms.json, as nerfstudio and instant-ngp write it."""

    document: dict[str, Any] = Field(description="The content of the file.")
    T_scene_file: Similarity | None = Field(
        None,
        description="From the world frame of the file to that of the scene. Default: the transform in the file, "
        "or the identity.",
    )
    every: Annotated[int, Field(ge=1, le=10_000, description="Use every N-th camera.")] = 1


class RenderBody(Incoming):
    """One rendering of a scene with edits. The cameras are given by one of `orbit`, `look_at`, `poses` and
    `transforms`. Default: an orbit."""

    scene: Reference = Field(description="The scene's field. It may be an edited scene.")
    edits: Annotated[list[Edit], Field(max_length=MOST_EDITS)] = Field([])
    orbit: Orbit | None = None
    look_at: Annotated[list[StationRequest], Field(min_length=1, max_length=MOST_CAMERAS)] | None = None
    poses: Annotated[list[PoseRequest], Field(min_length=1, max_length=MOST_CAMERAS)] | None = None
    transforms: CameraFile | None = None
    size: tuple[_Count, _Count] | None = Field(
        None, description="Width and height of every frame. Default: 480 x 360, or the size in the camera file."
    )
    options: RenderOptions = Field(default_factory=RenderOptions)
    outputs: Annotated[list[Output], Field(min_length=1, max_length=16)] = Field(
        ["color", "depth", "normal", "strip"],
        description="color, depth, normal: one file per frame. animation: WebP. strip: before and after. mesh: "
        "composite.glb. field: the edited scene as a new field.",
    )
    before: bool = Field(True, description="Whether the scene without its edits is rendered too.")
    mesh_resolution: _Resolution = 192
    field_resolution: _Resolution = 192
    seed: Annotated[int, Field(ge=0, le=2**32 - 1)] = 0
    webhook: Webhook | None = Field(None, description="As for a registration.")

    @model_validator(mode="after")
    def _has_one_kind_of_cameras(self) -> RenderBody:
        if sum(one is not None for one in (self.orbit, self.look_at, self.poses, self.transforms)) > 1:
            raise ValueError("give one of `orbit`, `look_at`, `poses` and `transforms`")
        return self

    def rendering(self, edits: Sequence[dict[str, Any]], poses: Sequence[dict[str, Any]] | None) -> RenderRequest:
        """The engine's request. edits: with a transform each · poses: those of ``transforms``.

        Raises InvalidInputError as ``RenderRequest.from_dict`` does.
        """
        values = self.model_dump(mode="json", exclude={"scene", "edits", "transforms", "webhook"}, exclude_none=True)
        values |= {"edits": list(edits), "outputs": list(dict.fromkeys(self.outputs))}
        return RenderRequest.from_dict(values if poses is None else values | {"poses": list(poses)})


class FileEntry(ArtifactEntry):
    """One file of a rendering."""

    kind: Literal["color", "depth", "normal", "animation", "strip", "mesh", "field", "report"] | None = None
    frame: int | None = Field(None, description="Number of the frame; null for a file about all frames.")
    before: bool = Field(False, description="Whether the file shows the scene without its edits.")


class RenderResultDocument(Outgoing):
    """The result of a rendering."""

    frames: int
    size: list[int]
    depth_unit: float = Field(
        description="Scene units per level of the depth PNGs. The level 0 means that the ray hit no surface."
    )
    seconds: dict[str, float] = Field({}, description="Time of each stage, seconds.")
    field: str | None = Field(
        None, description="SHA-256 of the edited scene's field, if the output `field` was requested."
    )
    seed: int = 0
    options: dict[str, Any] = Field({})
    engine: dict[str, Any] = Field({})
    artifacts: list[FileEntry] = Field([])
