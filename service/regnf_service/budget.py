"""What a caller's work may cost the workers in an hour."""

from __future__ import annotations

import math
from collections.abc import Mapping

from regnf_service.problem import Problem
from regnf_service.services import Services

_WINDOW_MINUTES = 60


def check_budget(services: Services, caller: str, headers: Mapping[str, str] | None = None) -> None:
    """Refuse new work of a caller whose work of the last hour has used up the budget.

    Measured seconds count, of failed work too. Raises Problem QUOTA_WORKER_SECONDS.
    """
    budget = services.settings.quota_worker_seconds_per_hour
    if budget is None:
        return
    wait_s = seconds_until_free(services.queue.spent(caller), budget, services.records.now())
    if wait_s:
        raise Problem("QUOTA_WORKER_SECONDS", headers={**(headers or {}), "Retry-After": str(wait_s)})


def seconds_until_free(spent: Mapping[int, float], budget: float, now: float) -> int:
    """When enough of what was spent is an hour ago, whole seconds from now; 0: now."""
    total = sum(spent.values())
    for minute, seconds in sorted(spent.items()):
        if total < budget:
            break
        total -= seconds
        free_at = (minute + _WINDOW_MINUTES) * 60
        if total < budget:
            return max(1, math.ceil(free_at - now))
    return 0
