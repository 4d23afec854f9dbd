"""Jobs of all kinds: what their requests are, and how a record's request is read."""

from __future__ import annotations

from regnf_state.records import JobRecord, UnreadableRecordError
from regnf_state.registration_request import RegistrationRequest
from regnf_state.rendering_request import RenderingRequest

REGISTRATION = "registration"
RENDERING = "render"
JobRequest = RegistrationRequest | RenderingRequest


def kind_of(request: JobRequest) -> str:
    """The kind of job that a request is for."""
    return RENDERING if isinstance(request, RenderingRequest) else REGISTRATION


def request_of(record: JobRecord) -> JobRequest:
    """The request of a job that has not ended. Raises UnreadableRecordError, and what reading its kind raises."""
    if record.kind == REGISTRATION:
        return RegistrationRequest.from_record(record.request)
    if record.kind == RENDERING:
        return RenderingRequest.from_record(record.request)
    raise UnreadableRecordError(record.id, "it is a job of another kind", newer=True)
