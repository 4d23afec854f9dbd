"""A worker that takes a registration whose fields are being imported puts it aside, and takes the next."""

from __future__ import annotations

from dataclasses import replace

import pytest
from redis import Redis

from regnf_service.upkeep.reaper import Reaper
from regnf_state.queue import Work
from regnf_state.redis.queue import JobQueue
from regnf_state.settings import Settings
from regnf_worker.models import Context
from regnf_worker.resilient_worker import Taken, Taking
from tests.worker.doubles import SHA, accept

JOB = Work("registration", "j1", 1)


@pytest.fixture
def taking(context: Context, any_redis: Redis) -> Taking:
    """A worker's, and a registration that waits."""
    accept(context)
    context.queue.enqueue_registration("j1", 1)
    return Taking(any_redis, JobQueue(any_redis))


def import_again(context: Context) -> None:
    """The job's field is being imported."""
    field = context.records.get_field(SHA)
    assert field is not None
    context.records.delete_field(SHA)
    context.records.create_field(replace(field, state="validating"))


def taken(taking: Taking) -> Taken:
    found = taking.pop(None)
    assert found is not None
    return found


def test_what_can_run_is_handed_out(taking: Taking) -> None:
    assert taking.accept(taken(taking)) == JOB
    assert taking.pop(None) is None


def test_what_waits_for_an_import_is_put_aside(context: Context, any_redis: Redis, taking: Taking) -> None:
    import_again(context)
    assert taking.accept(taken(taking)) is None
    assert taking.pop(None) is None
    assert context.queue.holds_registration("j1", 1)
    assert context.queue.awaited() == [SHA]
    reaper = Reaper(context.records, context.queue, any_redis, Settings())
    reaper.run_once()
    assert taking.pop(None) is None, "the import has not ended"
    context.records.update_field(SHA, state="ready")
    reaper.run_once()
    assert taking.accept(taken(taking)) == JOB, "although the worker that had the import died"


def test_an_import_that_ends_meanwhile_is_not_waited_for(
    monkeypatch: pytest.MonkeyPatch, context: Context, taking: Taking
) -> None:
    import_again(context)
    park = taking._queue.park

    def late(*arguments: object) -> None:
        context.records.update_field(SHA, state="ready")
        park(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(taking._queue, "park", late)
    assert taking.accept(taken(taking)) is None
    assert taking.accept(taken(taking)) == JOB


@pytest.mark.parametrize("end", ["cancelled", "deleted"])
def test_a_job_that_is_not_to_be_run_waits_for_nothing(context: Context, taking: Taking, end: str) -> None:
    import_again(context)
    context.records.request_cancel("j1")
    if end == "deleted":
        context.records.delete_job("j1")
    assert taking.accept(taken(taking)) == JOB, "its process finds that there is nothing to do"
