"""What POST /render takes, and the result of such a job."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from regnf_core.editing.request import MOST_EDITS
from regnf_core.rendering.options import RenderOptions
from regnf_core.rendering.request import OrbitRequest, Output, PoseRequest, RenderRequest, StationRequest
from regnf_service.http.schemas.common import Incoming, Outgoing
from regnf_service.http.schemas.detections import Detection
from regnf_service.http.schemas.edits import Edit
from regnf_service.http.schemas.registrations import Reference, Webhook
from regnf_service.http.schemas.results import ArtifactEntry
from regnf_service.http.schemas.transforms import Similarity

MOST_CAMERAS = 256
"""That a request lists: its record is held until the job ends."""
_Count = Annotated[int, Field(ge=1)]
_Resolution = Annotated[int, Field(ge=2, le=1024, description="Cells along the longest edge of the scene's bounds.")]


@dataclass(frozen=True)
class Orbit(OrbitRequest):
    """Cameras round one thing: the object of the edit of this number, or a box; left out: of the first edit, or without
    edits the whole scene."""

    detection: Detection | None = None


class CameraFile(Incoming):
    """The cameras of a transforms.json, as nerfstudio and instant-ngp write it."""

    document: dict[str, Any] = Field(description="All of the file.")
    T_scene_file: Similarity | None = Field(
        None, description="From the file's world to the scene's. Left out: as the file says, or the same."
    )
    every: Annotated[int, Field(ge=1, le=10_000, description="Take one camera of so many.")] = 1


class RenderBody(Incoming):
    """One rendering of a scene with its edits: one of `orbit`, `look_at`, `poses` and `transforms`, or an orbit."""

    scene: Reference = Field(description="The scene's field: an edited scene, too, is one.")
    edits: Annotated[list[Edit], Field(max_length=MOST_EDITS)] = Field([])
    orbit: Orbit | None = None
    look_at: Annotated[list[StationRequest], Field(min_length=1, max_length=MOST_CAMERAS)] | None = None
    poses: Annotated[list[PoseRequest], Field(min_length=1, max_length=MOST_CAMERAS)] | None = None
    transforms: CameraFile | None = None
    size: tuple[_Count, _Count] | None = Field(
        None, description="Width and height of every frame. Left out: 480 x 360, or as the cameras say."
    )
    options: RenderOptions = Field(default_factory=RenderOptions)
    outputs: Annotated[list[Output], Field(min_length=1, max_length=16)] = Field(
        ["color", "depth", "normal", "strip"],
        description="color, depth, normal: files of each frame. animation: WebP. strip: before and after. mesh: "
        "composite.glb. field: the edited scene, which becomes a field.",
    )
    before: bool = Field(True, description="Whether the scene without its edits is rendered too.")
    mesh_resolution: _Resolution = 192
    field_resolution: _Resolution = 192
    seed: Annotated[int, Field(ge=0, le=2**32 - 1)] = 0
    webhook: Webhook | None = Field(None, description="As of a registration.")

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
    """One file that a rendering has made."""

    kind: Literal["color", "depth", "normal", "animation", "strip", "mesh", "field", "report"] | None = None
    frame: int | None = Field(None, description="Its number; null for what is of all frames.")
    before: bool = Field(False, description="Whether it shows the scene without its edits.")


class RenderResultDocument(Outgoing):
    """What a rendering has made."""

    frames: int
    size: list[int]
    depth_unit: float = Field(description="Scene units that a level of the depth PNGs stands for; 0 is nothing met.")
    seconds: dict[str, float] = Field({}, description="Of each stage.")
    field: str | None = Field(None, description="SHA-256 of the edited scene's field, if it was asked for.")
    seed: int = 0
    options: dict[str, Any] = Field({})
    engine: dict[str, Any] = Field({})
    artifacts: list[FileEntry] = Field([])
