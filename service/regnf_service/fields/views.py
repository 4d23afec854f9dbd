"""The mesh and the picture of a field: a worker makes them when it has time, first those that somebody asks for."""

from __future__ import annotations

from contextlib import suppress

from regnf_service.problem import Problem
from regnf_service.services import Services
from regnf_state.records import FieldRecord, StaleAttemptError

_AGAIN = {"Retry-After": "1"}


def missing_view(services: Services, record: FieldRecord, reason: str) -> Problem:
    """What is to be said of a view that is not there: ``reason``. Blocking.

    With Retry-After while a worker is to make it, which it does sooner for this call.
    """
    if record.state != "ready":
        return Problem(reason)
    if record.views is None:  # imported by an earlier release
        with suppress(StaleAttemptError):
            services.records.update_field(record.sha256, attempt=record.attempt, views="pending")
    elif record.views == "pending":
        services.records.draw_next(record.sha256)
    return Problem(reason, headers=_AGAIN if record.views in (None, "pending") else None)
