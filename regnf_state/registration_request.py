"""What a registration job is asked to do: one typed value, from the HTTP route through the record to the engine."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from pydantic import TypeAdapter

from regnf_core.cost import Cost, estimate
from regnf_core.detections import Detection
from regnf_core.detections.images import AnyDetection, read_image_detections
from regnf_core.editing.request import EditRequest
from regnf_core.options import RegistrationOptions
from regnf_core.rendering import request as rendering_cost
from regnf_core.rendering.request import RenderRequest
from regnf_state.ownership import owner_of, reference_of
from regnf_state.records import JobRecord, UnreadableRecordError

Rows = list[list[float]]
"""A row-major 4x4 matrix."""
_VERSION = 1


class UnknownRequestVersionError(ValueError):
    """The record was written by another version of the program, which this one cannot read."""


@dataclass(frozen=True)
class RegistrationRequest:
    """One registration, or one search among ``candidates``: every default filled in, every value in its one form.

    Fields are named by SHA-256 towards callers, and by their owner's references in records: ``owned_by``.
    """

    scene: str
    object: str | None
    candidates: tuple[str, ...] | None
    detection: AnyDetection
    """A box in the scene, or one object in images of a scene that is a recording."""
    options: RegistrationOptions
    seed: int = 0
    initial_transform: Rows | None = None
    """T_object_scene to try first."""
    ground_truth: Rows | None = None
    """T_object_scene that the metrics compare with."""
    webhook: str | None = None
    """Address of the message about the job's end."""
    pictures: bool = True
    """Whether clouds and pictures of the result are made."""

    @property
    def objects(self) -> tuple[str, ...]:
        """The fields to be found in the scene: one, or all candidates."""
        if self.candidates is not None:
            return self.candidates
        return () if self.object is None else (self.object,)

    def owned_by(self, caller: str) -> RegistrationRequest:
        """The same request over the caller's own fields."""
        return replace(
            self,
            scene=reference_of(caller, self.scene),
            object=None if self.object is None else reference_of(caller, self.object),
            candidates=None if self.candidates is None else tuple(reference_of(caller, one) for one in self.candidates),
        )

    def values(self) -> dict[str, Any]:
        """Plain (JSON) values; equal requests have equal ones."""
        values = {
            "scene": self.scene,
            "object": self.object,
            "candidates": None if self.candidates is None else list(self.candidates),
            "detection": values_of(self.detection),
            "options": self.options.to_dict(),
            "seed": self.seed,
            "initial_transform": self.initial_transform,
            "ground_truth": None if self.ground_truth is None else {"T_object_scene": self.ground_truth},
        }
        if not self.pictures:  # a request that says nothing of them keeps the id that it has always had
            values["pictures"] = False
        return values if self.webhook is None else values | {"webhook": {"url": self.webhook}}

    def to_record(self) -> dict[str, Any]:
        """The values as a job's record keeps them, with the version of their form."""
        return self.values() | {"version": _VERSION}

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> RegistrationRequest:
        """The request that ``to_record`` wrote. Raises UnknownRequestVersionError, InvalidOptionsError."""
        if record.get("version") != _VERSION:
            raise UnknownRequestVersionError(f"the request has version {record.get('version')}, not {_VERSION}")
        candidates, truth, webhook = record["candidates"], record["ground_truth"], record.get("webhook")
        return cls(
            scene=record["scene"],
            object=record["object"],
            candidates=None if candidates is None else tuple(candidates),
            detection=_recorded(record["detection"]),
            options=RegistrationOptions.from_dict(record["options"]),
            seed=record["seed"],
            initial_transform=record["initial_transform"],
            ground_truth=None if truth is None else truth["T_object_scene"],
            webhook=None if webhook is None else webhook["url"],
            pictures=record.get("pictures", True),
        )


def values_of(detection: AnyDetection) -> Any:
    """A detection as plain (JSON) values: a list of those in images."""
    return detection.values() if isinstance(detection, Detection) else [one.values() for one in detection]


def _recorded(values: Any) -> AnyDetection:
    """The box of recorded values, as they are: to normalize the quaternion again might change its last bits."""
    if isinstance(values, list):
        return read_image_detections(values)
    members: dict[str, Any] = {n: tuple(one) if isinstance(one, list) else one for n, one in values.items()}
    return Detection(**members)


# What a rendering job is asked to do: one typed value, from the HTTP route through the record to the engine.

_ADAPTER = TypeAdapter(RenderRequest)


@dataclass(frozen=True)
class RenderingRequest:
    """One rendering of a scene with its edits: every default filled in, every edit with a transform of its own.

    The scene is named by SHA-256 towards callers, and by its owner's reference in records: ``owned_by``. Objects of
    edits are named by SHA-256; they are fields of the scene's owner.
    """

    scene: str
    rendering: RenderRequest
    webhook: str | None = None
    """Address of the message about the job's end."""

    @property
    def objects(self) -> tuple[str, ...]:
        """The references of the fields that edits name, each once."""
        owner = owner_of(self.scene)
        named = (name for edit in self.rendering.edits for name in objects_of(edit).values())
        return tuple(dict.fromkeys(reference_of(owner, name) for name in named))

    def owned_by(self, caller: str) -> RenderingRequest:
        """The same request over the caller's own fields."""
        return replace(self, scene=reference_of(caller, self.scene))

    def values(self) -> dict[str, Any]:
        """Plain (JSON) values; equal requests have equal ones."""
        values = {"scene": self.scene, **_ADAPTER.dump_python(self.rendering, mode="json")}
        return values if self.webhook is None else values | {"webhook": {"url": self.webhook}}

    def to_record(self) -> dict[str, Any]:
        """The values as a job's record keeps them, with the fields that it reads and the version of their form."""
        record = {"scene": self.scene, "objects": list(self.objects), "version": _VERSION}
        record["rendering"] = _ADAPTER.dump_python(self.rendering, mode="json")
        return record if self.webhook is None else record | {"webhook": {"url": self.webhook}}

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> RenderingRequest:
        """The request that ``to_record`` wrote. Raises UnknownRequestVersionError, InvalidInputError."""
        if record.get("version") != _VERSION:
            raise UnknownRequestVersionError(f"the request has version {record.get('version')}, not {_VERSION}")
        webhook = record.get("webhook")
        rendering = RenderRequest.from_dict(record["rendering"])
        return cls(record["scene"], rendering, None if webhook is None else webhook["url"])


def objects_of(edit: EditRequest) -> dict[str, str]:
    """The fields that an edit names, by the members that name them."""
    named = {member: getattr(edit, member, None) for member in ("object", "replacement")}
    return {member: name for member, name in named.items() if name is not None}


# Jobs of all kinds: what their requests are, and how a record's request is read.

REGISTRATION = "registration"
RENDERING = "render"
JobRequest = RegistrationRequest | RenderingRequest


def kind_of(request: JobRequest) -> str:
    return RENDERING if isinstance(request, RenderingRequest) else REGISTRATION


def request_of(record: JobRecord) -> JobRequest:
    """The request of a job that has not ended. Raises UnreadableRecordError, and what reading its kind raises."""
    if record.kind == REGISTRATION:
        return RegistrationRequest.from_record(record.request)
    if record.kind == RENDERING:
        return RenderingRequest.from_record(record.request)
    raise UnreadableRecordError(record.id, "it is a job of another kind", newer=True)


# What a job will cost a worker, estimated from its request alone: for limits.


def estimated_cost(request: JobRequest) -> Cost:
    """Memory, and seconds of a worker on one core, by the request's options and the number of its objects or frames.

    The seconds are right within a factor of ten: the fields themselves decide.
    """
    if isinstance(request, RenderingRequest):
        return rendering_cost.estimate(request.rendering)
    return estimate(request.options, max(1, len(request.objects)))
