"""The mesh and the picture of a field: a worker makes them when it has time, first those that somebody asks for."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

from regnf_service.problem import Problem
from regnf_service.services import Services
from regnf_state.field_views import view_key
from regnf_state.records import FieldRecord, StaleAttemptError

_AGAIN = {"Retry-After": "1"}


def stored_view(services: Services, record: FieldRecord, names: Sequence[str], reason: str) -> bytes:
    """The first of the files ``names`` that a ready field has.

    Raises Problem ``reason``; with Retry-After while a worker is to make them, which it does sooner for this call.
    """
    if record.state != "ready":
        raise Problem(reason)
    for name in names:
        with suppress(FileNotFoundError), services.blobs.open(view_key(record.sha256, name)) as file:
            return file.read()
    if record.views is None:  # imported by an earlier release
        with suppress(StaleAttemptError):
            services.records.update_field(record.sha256, attempt=record.attempt, views="pending")
    elif record.views == "pending":
        services.records.draw_next(record.sha256)
    raise Problem(reason, headers=_AGAIN if record.views in (None, "pending") else None)
