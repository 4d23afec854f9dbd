"""Requests whose options multiply to more memory or time than one job may have are refused before they are queued."""

from __future__ import annotations

from typing import Literal

from regnf_core.cost import Cost, Term, estimate
from regnf_core.options import RegistrationOptions
from regnf_service.problem import Problem, json_pointer
from regnf_state.job_cost import estimated_cost
from regnf_state.registration_request import RegistrationRequest
from regnf_state.settings import Settings

DEFAULT_MEMORY_BYTES = 4 << 30
"""The most that a request may be estimated at where REGNF_JOB_MEMORY_BYTES says nothing else."""
_SECONDS_ARE_WITHIN = 10.0
"""Fields differ in speed by this factor either way: what the fastest ones would do in time is taken."""
_GIB = 1 << 30


def check_cost(settings: Settings, request: RegistrationRequest) -> None:
    """Raises Problem OPTIONS_TOO_COSTLY. What default options cost is never refused, however low the limits are."""
    cost = estimated_cost(request)
    usual = estimate(RegistrationOptions(preset=request.options.preset), max(1, len(request.objects)))
    memory = max(settings.job_memory_bytes or DEFAULT_MEMORY_BYTES, usual.memory_bytes)
    if cost.memory_bytes > memory:
        estimated, limit = f"{cost.memory_bytes / _GIB:.1f} GiB of memory", f"{memory / _GIB:.1f} GiB"
        raise _refusal(cost, "memory_bytes", estimated, limit)
    seconds = max(settings.job_timeout_s, usual.seconds)
    least = cost.seconds / _SECONDS_ARE_WITHIN
    if least > seconds:
        raise _refusal(cost, "seconds", f"at least {least:,.0f} s", f"{seconds:,.0f} s")


def _refusal(cost: Cost, of: Literal["memory_bytes", "seconds"], estimated: str, limit: str) -> Problem:
    term = cost.largest(of)
    detail = f"The job is estimated to take {estimated}; the limit is {limit}. Most of it is for {_count(term)}."
    errors = [
        {"pointer": json_pointer(("options", *option)), "detail": f"{_count(term)}: {estimated}, limit {limit}"}
        for option in term.options
    ]
    return Problem("OPTIONS_TOO_COSTLY", detail, errors=errors)


def _count(term: Term) -> str:
    return f"{term.count:,} {term.counts}"
