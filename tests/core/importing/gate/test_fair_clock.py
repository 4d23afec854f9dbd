"""A child's limit counts the time that it had: what others had of the cores is no reason to end it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from regnf_core.importing.gate.child import FairClock, waited_s


@pytest.mark.parametrize(
    ("passed", "waited", "left"),
    [(0.0, 0.0, 10.0), (4.0, 0.0, 6.0), (4.0, 1.5, 7.5), (12.0, 0.0, 0.0), (12.0, 5.0, 3.0), (30.0, 25.0, 0.0)],
)
def test_time_without_a_core_does_not_count(passed: float, waited: float, left: float) -> None:
    times = iter((100.0, 100.0 + passed))
    clock = FairClock(1, 10.0, now=lambda: next(times), waited=lambda _: waited)
    assert clock.left_s() == pytest.approx(left)


def test_of_a_process_that_is_no_more_nothing_is_told() -> None:
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()
    assert waited_s(child.pid) == 0.0


def test_a_process_that_shares_its_core_waits() -> None:
    """Both count until it shows, however long that takes."""
    if not Path("/proc/self/schedstat").exists():
        pytest.skip("this system keeps no account of waiting")
    core = min(os.sched_getaffinity(0))
    count = f"import os\nos.sched_setaffinity(0, {{{core}}})\nwhile True: pass"
    children = [subprocess.Popen([sys.executable, "-c", count]) for _ in range(2)]
    try:
        while not all(waited_s(child.pid) > 0.05 for child in children):
            assert all(child.poll() is None for child in children)
    finally:
        for child in children:
            child.kill()
            child.wait()
