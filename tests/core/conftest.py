"""One registration of the analytic chair, shared by the tests that look at its result."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch

from regnf_core.document import RegistrationResult
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3
from regnf_core.library import register
from regnf_core.options import RegistrationOptions
from tests.core.analytic import chair, chair_box, chair_pose, room

QUICK = {
    "preset": "paper",
    "sampling": {"pixel_stride": 12},
    "optimization": {"iterations": 120, "samples_per_iteration": 800},
    "resampling": {"max_samples": 2000},
}
"""Options that keep a test's registration with the published method to a few seconds."""


@dataclass(frozen=True)
class ChairRun:
    """A finished registration with everything that went into it."""

    truth: Sim3
    detection: OrientedBox
    result: RegistrationResult


@pytest.fixture(scope="session")
def chair_run() -> ChairRun:
    """The chair at scale 1.25 in the room, registered with QUICK options and seed 1."""
    truth = chair_pose(1.25)
    detection = chair_box(truth)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        result = register(room(truth), chair(), detection, RegistrationOptions.from_dict(QUICK), seed=1)
    finally:
        torch.set_num_threads(threads)
    return ChairRun(truth, detection, result)
