"""Stopping a batch, and having one go on that was posted again."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

from regnf_service.problem import Problem
from regnf_service.services import Services
from regnf_state.batch_records import Batch, BatchName, BatchState, OpenPair
from regnf_state.batches import StaleBatchError, numbers_with

_MOST_TRIES = 20


def cancel(services: Services, batch: Batch) -> BatchState:
    """Hand out no further pair, and stop the jobs that this batch has started. Raises Problem CONFLICT."""

    def dismiss(state: BatchState) -> BatchState | None:
        if state.status != "running":
            return None
        now = services.records.now()
        stopped = [replace(one, stopped=one.started) for one in state.open]
        return replace(state, status="dismissed", finished=now, updated=now, waits_for=None, open=stopped)

    before, after = _change(services, batch.name, dismiss)
    if after is not before:
        stop_jobs(services, batch.name, before.open)
    return after


def go_on(services: Services, batch: Batch) -> BatchState:
    """The batch was posted again: one that was cancelled goes on, one that has ended does its failed pairs again."""

    def resume(state: BatchState) -> BatchState | None:
        now = services.records.now()
        again = replace(state, status="running", finished=None, since=now, updated=now)
        if state.status == "dismissed":
            return again
        if state.status == "running" or not state.counts.get("failed"):
            return None
        failed = numbers_with(services.batches.results(batch.name, state), "failed")
        counts = {name: count for name, count in state.counts.items() if name != "failed"}
        todo = f"{sum(1 << number for number in failed):x}"
        return replace(again, passes=state.passes + 1, next=1, offset=0, todo=todo, counts=counts)

    return _change(services, batch.name, resume)[1]


def stop_jobs(services: Services, name: BatchName, pairs: Iterable[OpenPair]) -> None:
    """Cancel the jobs that a batch has started and that no other batch of its caller waits for."""
    others = [other for other in services.batches.index.open() if other.owner == name.owner and other != name]
    needed = {one.job for other in others for one in services.batches.state(other).open}
    for job_id in {one.job for one in pairs if one.started and one.job} - needed:
        job = services.records.request_cancel(job_id)
        if job is not None and job.status not in ("successful", "failed"):
            services.queue.stop(job_id, job.attempt)


def _change(
    services: Services, name: BatchName, change: Callable[[BatchState], BatchState | None]
) -> tuple[BatchState, BatchState]:
    """The state before and after ``change`` was written as the next block; the same where it says None."""
    for _ in range(_MOST_TRIES):
        before = services.batches.state(name)
        after = change(before)
        if after is None:
            return before, before
        try:
            return before, services.batches.write(name, after)
        except StaleBatchError:
            continue
    raise Problem("CONFLICT")
