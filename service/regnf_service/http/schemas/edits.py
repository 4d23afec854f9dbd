"""The edits of POST /render: each names a finished registration, or an object and its transform."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Discriminator, Field, StringConstraints, model_validator

from regnf_core.editing.request import Axis, Name, Residual
from regnf_core.rgb import Rgb
from regnf_service.http.schemas.common import Incoming
from regnf_service.http.schemas.detections import Detection
from regnf_service.http.schemas.registrations import Reference
from regnf_service.http.schemas.transforms import Similarity, rows_of

KINDS = frozenset({"substitution", "replacement", "removal", "insertion"})
_JobId = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_-]{1,64}$")]
_EITHER = "an edit has either `job`, or `object` and `T_object_scene`"


class _Edit(Incoming):
    name: Name | None = Field(None, description="For people.")

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

    job: _JobId | None = Field(None, description="A finished registration in this scene: its object, where it is.")
    object: Reference | None = Field(None, description="Instead of `job`: the field of what stands there.")
    T_object_scene: Similarity | None = Field(None, description="With `object`: scene to object coordinates.")
    residual: Residual | None = Field(
        None, description="How far surfaces are apart, object units: of the job's result where it is left out."
    )

    def named(self) -> bool:
        """Whether a thing is named at all. Raises ValueError for half of a name, or for two."""
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
    """The object's own field where the scene shows the object."""

    kind: Literal["substitution"]
    tint: Rgb | None = Field(None, description="sRGB, 0 to 1: what its surface is colored with.")


class Replacement(_OfNamedObject):
    """Another object in place of one that was registered."""

    kind: Literal["replacement"]
    replacement: Reference = Field(description="The field of what will stand there.")
    T_replacement_object: Similarity | None = Field(
        None, description="From the object's coordinates to the replacement's. Left out: on the same base, as large."
    )
    match: Literal["height", "diagonal"] = "height"
    up_object: Axis = "z"
    up_replacement: Axis = "z"
    tint: Rgb | None = None


class Removal(_OfObject):
    """What stands in the box, or what was registered, is taken away; floor and walls go on."""

    kind: Literal["removal"]
    detection: Detection | None = Field(None, description="A box round all of it, in the scene.")

    @model_validator(mode="after")
    def _names_something(self) -> Removal:
        if not self.named() and self.detection is None:
            raise ValueError("a removal needs `detection`, `job`, or `object` and `T_object_scene`")
        return self


class Insertion(_Edit):
    """An object where nothing of the scene is removed."""

    kind: Literal["insertion"]
    object: Reference
    T_object_scene: Similarity = Field(description="Scene to object coordinates: any similarity.")
    tint: Rgb | None = None


Edit = Annotated[Substitution | Replacement | Removal | Insertion, Discriminator("kind")]
