"""What a rendering job is asked to do: one typed value, from the HTTP route through the record to the engine."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from pydantic import TypeAdapter

from regnf_core.editing.request import EditRequest
from regnf_core.rendering.request import RenderRequest
from regnf_state.ownership import owner_of, reference_of
from regnf_state.registration_request import UnknownRequestVersionError

_VERSION = 1
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
