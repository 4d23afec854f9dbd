"""How patient the service is in these tests: as it is in production, or shortened so that the tests are quick."""

from __future__ import annotations

import os
from dataclasses import dataclass, field

from regnf_state.settings import variables

VARIABLE = "REGNF_TEST_PACE"
REQUEST_TIMEOUT_S = 0.7
"""Of a request to the object store, in the short version."""


@dataclass(frozen=True)
class Pace:
    """Settings for every process, and how long a fault lasts. ``whole``: production's own intervals."""

    whole: bool
    settings: dict[str, str] = field(default_factory=dict)

    def lasting(self, short_s: float, whole_s: float) -> float:
        """For how long a test lets a fault last, seconds."""
        return whole_s if self.whole else short_s


_WHOLE = Pace(whole=True, settings={VARIABLE: "whole"})
_SHORT = Pace(whole=False, settings=variables(heartbeat_s=0.2, lost_after_s=2.4, shutdown_grace_s=0.5))


def pace() -> Pace:
    """The one that the environment names."""
    return _WHOLE if os.environ.get(VARIABLE) == "whole" else _SHORT
