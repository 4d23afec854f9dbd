"""Requests that multiply to more memory, time or files than one job may have are refused before they are queued."""

from __future__ import annotations

from dataclasses import dataclass

from regnf_core.cost import Cost, Term, estimate
from regnf_core.options import RegistrationOptions
from regnf_core.rendering import cost as rendering_cost
from regnf_core.rendering.request import RenderRequest
from regnf_service.problem import Problem, json_pointer
from regnf_state.job_cost import estimated_cost
from regnf_state.job_request import JobRequest
from regnf_state.rendering_request import RenderingRequest
from regnf_state.settings import Settings

DEFAULT_MEMORY_BYTES = 4 << 30
"""The most that a request may be estimated at where REGNF_JOB_MEMORY_BYTES says nothing else."""
_SECONDS_ARE_WITHIN = 10.0
"""Fields differ in speed by this factor either way: what the fastest ones would do in time is taken."""
_GIB = 1 << 30


@dataclass(frozen=True)
class _Refusals:
    """How requests of a kind are refused. within: where in the body their options are."""

    reason: str
    within: tuple[str, ...] = ()


_OF_REGISTRATIONS = _Refusals("OPTIONS_TOO_COSTLY", ("options",))
_OF_RENDERINGS = _Refusals("RENDER_TOO_LARGE")


def check_cost(settings: Settings, request: JobRequest) -> None:
    """Raises Problem OPTIONS_TOO_COSTLY, or RENDER_TOO_LARGE for a rendering.

    What default options cost is never refused, however low the limits are.
    """
    cost = estimated_cost(request)
    if isinstance(request, RenderingRequest):
        _check_files(settings, request)
        _check(settings, cost, rendering_cost.estimate(RenderRequest()), _OF_RENDERINGS)
    else:
        usual = estimate(RegistrationOptions(preset=request.options.preset), max(1, len(request.objects)))
        _check(settings, cost, usual, _OF_REGISTRATIONS)


def _check(settings: Settings, cost: Cost, usual: Cost, refusals: _Refusals) -> None:
    memory = max(settings.job_memory_bytes or DEFAULT_MEMORY_BYTES, usual.memory_bytes)
    if cost.memory_bytes > memory:
        estimated, limit = f"{cost.memory_bytes / _GIB:.1f} GiB of memory", f"{memory / _GIB:.1f} GiB"
        raise _refusal(cost.largest("memory_bytes"), estimated, limit, refusals)
    seconds = max(settings.job_timeout_s, usual.seconds)
    least = cost.seconds / _SECONDS_ARE_WITHIN
    if least > seconds:
        raise _refusal(cost.largest("seconds"), f"at least {least:,.0f} s", f"{seconds:,.0f} s", refusals)


def _check_files(settings: Settings, request: RenderingRequest) -> None:
    files, limit = rendering_cost.estimate(request.rendering).file_bytes, settings.job_scratch_bytes
    if files > limit:
        detail = f"The files may take {files / _GIB:.1f} GiB; the limit is {limit / _GIB:.1f} GiB."
        fault = {"pointer": "/outputs", "detail": detail}
        hint = "Ask for fewer or smaller frames, or for fewer outputs."
        raise Problem(_OF_RENDERINGS.reason, detail, errors=[fault], hint=hint)


def _refusal(term: Term, estimated: str, limit: str, refusals: _Refusals) -> Problem:
    detail = f"The job is estimated to take {estimated}; the limit is {limit}. Most of it is for {_count(term)}."
    errors = [
        {
            "pointer": json_pointer((*refusals.within, *option)),
            "detail": f"{_count(term)}: {estimated}, limit {limit}",
        }
        for option in term.options
    ]
    return Problem(refusals.reason, detail, errors=errors)


def _count(term: Term) -> str:
    return f"{term.count:,} {term.counts}"
