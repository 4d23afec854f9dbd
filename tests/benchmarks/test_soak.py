"""The reduced form of benchmarks.service_load.soak: real jobs while their processes and Redis are killed."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.service_load.soak import Plan, judged, soak


@pytest.mark.long
def test_every_job_ends_as_it_should_while_its_process_and_redis_are_killed(tmp_path: Path) -> None:
    actions = (("job", 2), ("redis", 1))
    plan = Plan(9, seed=1, clients=4, workers=1, questions=1, actions=actions, pauses_s=(0.3, 1.0), max_actions=4)
    run = soak(tmp_path, plan)
    assert judged(run) == []
    assert run.outcomes.total() == 9
    assert run.done.total() == 4
