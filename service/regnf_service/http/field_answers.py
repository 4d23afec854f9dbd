"""The mesh and the picture of a field: a worker makes them when it has time, first those that somebody asks for."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

from starlette.requests import Request
from starlette.responses import Response

from regnf_service.concurrency import in_thread
from regnf_service.http.etags import IfNoneMatch, field_etag
from regnf_service.http.ranges import file_answer
from regnf_service.problem import Problem
from regnf_service.services import Services
from regnf_state.field_views import view_key
from regnf_state.records import FieldRecord, StaleAttemptError

_AGAIN = {"Retry-After": "1"}
_CACHING = "private, max-age=3600"


async def view_answer(
    request: Request,
    services: Services,
    record: FieldRecord,
    names: Sequence[str],
    reason: str,
    media_type: str,
    held: IfNoneMatch,
) -> Response:
    """The first of the files ``names`` that a ready field has.

    Raises Problem ``reason``; with Retry-After while a worker is to make them, which it does sooner for this call.
    """
    if record.state == "ready":
        headers = {"ETag": field_etag(record), "Cache-Control": _CACHING}
        for name in names:
            with suppress(FileNotFoundError):
                key = view_key(record.sha256, name)
                return await file_answer(request, services.blobs, key, media_type, headers, held)
    raise await in_thread(_missing, services, record, reason)


def _missing(services: Services, record: FieldRecord, reason: str) -> Problem:
    """What is to be said of a view that is not there. A worker is told that somebody asks for it."""
    if record.state != "ready":
        return Problem(reason)
    if record.views is None:  # imported by an earlier release
        with suppress(StaleAttemptError):
            services.records.update_field(record.sha256, attempt=record.attempt, views="pending")
    elif record.views == "pending":
        services.records.draw_next(record.sha256)
    return Problem(reason, headers=_AGAIN if record.views in (None, "pending") else None)
