"""The attack by kills tells work that died too often from work that failed for another reason."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.attacks.deaths import Deaths
from benchmarks.service_load.soak import Plan, judged, soak


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def deaths(clock: Clock) -> Deaths:
    """One from 10 to 12, one of the API at 20, one at 30; one attempt at 40 that found nothing to kill."""
    made = Deaths(clock)

    def lasting(seconds: float, done: bool = True) -> bool:
        clock.now += seconds
        return done

    clock.now = 10
    assert made.during("worker", lambda: lasting(2.0))
    clock.now = 20
    assert made.during("API, frozen for a while", lambda: lasting(0.0))
    clock.now = 30
    assert made.during("worker", lambda: lasting(0.0))
    clock.now = 40
    assert not made.during("process inside the gate", lambda: lasting(0.0, done=False))
    return made


@pytest.mark.parametrize(
    ("reason", "moment", "excused"),
    [
        ("WORKER_LOST", 5.0, True),
        ("WORKER_LOST", 11.0, True),
        ("WORKER_LOST", 13.0, False),
        ("IMPORT_OUT_OF_MEMORY", 5.0, True),
        ("IMPORT_OUT_OF_MEMORY", 31.0, False),
        ("INTERNAL", 5.0, False),
        ("", 5.0, False),
    ],
)
def test_only_what_may_have_died_twice_is_excused(deaths: Deaths, reason: str, moment: float, excused: bool) -> None:
    assert deaths.excuse(reason, moment) == excused


def test_time_is_counted_from_the_last_death(deaths: Deaths, clock: Clock) -> None:
    clock.now = 100
    assert (deaths.last_end(5.0), deaths.last_end(60.0)) == (30.0, 60.0)


# The reduced form of benchmarks.service_load.soak: real jobs while their processes and Redis are killed.


@pytest.mark.long
def test_every_job_ends_as_it_should_while_its_process_and_redis_are_killed(tmp_path: Path) -> None:
    actions = (("job", 2), ("redis", 1))
    plan = Plan(9, seed=1, clients=4, workers=1, questions=1, actions=actions, pauses_s=(0.3, 1.0), max_actions=4)
    run = soak(tmp_path, plan)
    assert judged(run) == []
    assert run.outcomes.total() == 9
    assert run.done.total() == 4
