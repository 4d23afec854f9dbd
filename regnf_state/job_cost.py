"""What a registration will cost a worker, estimated from its request alone: for limits."""

from __future__ import annotations

from regnf_core.cost import Cost, estimate
from regnf_state.registration_request import RegistrationRequest


def estimated_cost(request: RegistrationRequest) -> Cost:
    """Memory, and seconds of a worker on one core, by the request's options and the number of its objects.

    The seconds are right within a factor of ten: the fields themselves decide.
    """
    return estimate(request.options, max(1, len(request.objects)))
