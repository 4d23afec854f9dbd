"""What the worker overrides and uses of RQ, as read in RQ 2.12: another RQ must be read again before it is allowed."""

from __future__ import annotations

import inspect
import re
import tomllib
from importlib.metadata import version
from pathlib import Path

import pytest
from redis import Redis
from rq import Worker

from regnf_worker import resilient_worker
from regnf_worker.process import RegnfWorker

ROOT = Path(__file__).resolve().parents[2]
READ_IN = "2.12"
OVERRIDDEN = {
    "check_for_suspension": "(self, burst: 'bool')",
    "dequeue_job_and_maintain_ttl": "(self, timeout: 'int | None', max_idle_time: 'int | None' = None)"
    " -> 'tuple[Job, Queue] | None'",
    "execute_job": "(self, job: 'Job', queue: 'Queue')",
    "handle_payload": "(self, message)",
    "heartbeat": "(self, timeout: 'int | None' = None, pipeline: 'Pipeline | None' = None)",
    "register_birth": "(self)",
    "request_stop": "(self, signum, frame)",
    "run_maintenance_tasks": "(self)",
    "set_state": "(self, state: 'str', pipeline: 'Pipeline | None' = None)",
    "subscribe": "(self)",
    "teardown": "(self)",
}
CALLED = {
    "cleanup_execution": "(self, job: 'Job', pipeline: 'Pipeline')",
    "maintain_heartbeats": "(self, job: 'Job')",
    "prepare_execution": "(self, job: 'Job') -> 'Execution'",
    "prepare_job_execution": "(self, job: 'Job', remove_from_intermediate_queue: 'bool' = False) -> 'None'",
    "serialize": "(self) -> 'dict'",
    "setup_work_horse_signals": "(self)",
}
ATTRIBUTES = ("_horse_pid", "_stop_requested", "connection", "job_monitoring_interval", "key", "log", "name")


def overridden() -> set[str]:
    """The methods of RQ's worker that ours define anew."""
    ours = [kind for kind in RegnfWorker.__mro__ if not kind.__module__.startswith("rq.") and kind is not object]
    return {
        name
        for kind in ours
        for name in vars(kind)
        if not name.startswith("__") and callable(getattr(Worker, name, None))
    }


def test_every_override_is_listed() -> None:
    assert overridden() == OVERRIDDEN.keys()
    text = resilient_worker.__doc__ or ""
    assert f"RQ {READ_IN}" in text
    assert {name for name in OVERRIDDEN if re.search(rf"\b{name}\b", text)} == OVERRIDDEN.keys()


@pytest.mark.parametrize(("name", "signature"), sorted((OVERRIDDEN | CALLED).items()))
def test_rq_still_has_the_method_as_it_was_read(name: str, signature: str) -> None:
    assert str(inspect.signature(getattr(Worker, name))) == signature


def test_rq_still_has_the_attributes() -> None:
    worker = Worker(["q"], connection=Redis(), prepare_for_work=False)
    assert [name for name in ATTRIBUTES if not hasattr(worker, name)] == []


def test_only_the_rq_that_was_read_is_allowed() -> None:
    assert version("rq").startswith(f"{READ_IN}.")
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    bounds = {line for lines in extras.values() for line in lines if re.match(r"rq\b", line)}
    assert bounds == {"rq>=2.12,<2.13"}
