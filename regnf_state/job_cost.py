"""What a job will cost a worker, estimated from its request alone: for limits."""

from __future__ import annotations

from regnf_core.cost import Cost, estimate
from regnf_core.rendering import cost as rendering_cost
from regnf_state.job_request import JobRequest
from regnf_state.rendering_request import RenderingRequest


def estimated_cost(request: JobRequest) -> Cost:
    """Memory, and seconds of a worker on one core, by the request's options and the number of its objects or frames.

    The seconds are right within a factor of ten: the fields themselves decide.
    """
    if isinstance(request, RenderingRequest):
        return rendering_cost.estimate(request.rendering)
    return estimate(request.options, max(1, len(request.objects)))
