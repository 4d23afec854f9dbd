"""What a registration will cost a worker, estimated from its request alone: for limits, and for fair queueing."""

from __future__ import annotations

from regnf_core.cost import Cost, estimate
from regnf_state.registration_request import RegistrationRequest


def estimated_cost(request: RegistrationRequest) -> Cost:
    """Memory and seconds by the request's options and the number of its objects."""
    return estimate(request.options, max(1, len(request.objects)))


def estimated_worker_seconds(request: RegistrationRequest) -> float:
    """Seconds of a worker on one core; 2 at least. Right within a factor of ten: the fields themselves decide."""
    return estimated_cost(request).seconds
