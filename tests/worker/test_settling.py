"""What becomes of a record whose process has ended without a word."""

import pytest

from regnf_state.manifest import Manifest
from regnf_worker.artifacts import publish
from regnf_worker.models import Context
from regnf_worker.settle import ChildExit, settle_import, settle_registration
from tests.worker.doubles import SHA, accept, begin_import, ending, field, job


@pytest.mark.parametrize(
    ("end", "reason"),
    [
        (ChildExit(signal=11), "WORKER_LOST"),
        (ChildExit(signal=11, out_of_memory=True), "WORKER_LOST"),
        (ChildExit(signal=9, out_of_memory=True), "OUT_OF_MEMORY"),
        (ChildExit(signal=9, late=True, out_of_memory=True), "JOB_TIMEOUT"),
        (ChildExit(late=True), "JOB_TIMEOUT"),
    ],
)
@pytest.mark.parametrize("claimed", [True, False])
def test_how_a_process_ended_is_how_its_job_failed(
    context: Context, end: ChildExit, reason: str, claimed: bool
) -> None:
    accept(context)
    if claimed:
        context.records.update_job("j1", 1, status="running", worker="w")
    context.blobs.put("jobs/j1/1/half", b".")
    settle_registration(context, "j1", 1, "w", end)
    assert ending(context) == ("failed", reason)
    assert list(context.blobs.list("jobs")) == []


@pytest.mark.parametrize(
    ("end", "reason"),
    [(ChildExit(), "INTERNAL"), (ChildExit(signal=9), "WORKER_LOST"), (ChildExit(signal=15), "WORKER_LOST")],
)
def test_a_process_that_vanishes_is_given_a_second_chance_and_no_third(
    context: Context, end: ChildExit, reason: str
) -> None:
    accept(context)
    context.blobs.put("jobs/j1/1/half", b".")
    settle_registration(context, "j1", 1, "w", end)
    assert (job(context).status, job(context).attempt, job(context).requeues) == ("accepted", 2, 1)
    assert context.queue.holds_registration("j1", 2)
    settle_registration(context, "j1", 2, "w", end)
    assert ending(context) == ("failed", reason)
    assert reason == "WORKER_LOST" or "request" not in (job(context).error or {})["detail"], "no request failed here"
    assert list(context.blobs.list("jobs")) == []


def test_somebody_elses_job_is_left_alone(context: Context) -> None:
    accept(context)
    running = context.records.update_job("j1", 1, status="running", worker="other")
    settle_registration(context, "j1", 1, "w", ChildExit(signal=9))
    assert job(context) == running


@pytest.mark.parametrize("status", ["successful", "dismissed"])
def test_a_killed_process_whose_result_stands_or_whose_job_was_cancelled(context: Context, status: str) -> None:
    accept(context)
    context.records.update_job("j1", 1, status="running", worker="w")
    if status == "successful":
        publish(context.blobs, Manifest("j1", 1, ()))
    else:
        context.records.request_cancel("j1")
    settle_registration(context, "j1", 1, "w", ChildExit(signal=9))
    assert job(context).status == status


@pytest.mark.parametrize(
    ("end", "reason"), [(ChildExit(signal=11), "WORKER_LOST"), (ChildExit(late=True, signal=9), "IMPORT_TIMEOUT")]
)
def test_a_killed_import_rejects_its_field(context: Context, end: ChildExit, reason: str) -> None:
    begin_import(context)
    settle_import(context, SHA, 1, "w", end)
    error = field(context).error
    assert error is not None
    assert (field(context).state, error["reason"]) == ("rejected", reason)
    if end.late:
        assert "120 s" in error["detail"]
        assert "REGNF_IMPORT_TIMEOUT_S" in error["detail"]
    assert list(context.blobs.list("")) == []


@pytest.mark.parametrize("given_back", [True, False])
def test_an_import_given_back_or_killed_starts_anew(context: Context, given_back: bool) -> None:
    begin_import(context)
    settle_import(context, SHA, 1, "w", ChildExit(signal=9, given_back=given_back))
    requeues = 0 if given_back else 1
    assert (field(context).state, field(context).attempt, field(context).requeues) == ("validating", 2, requeues)
    assert context.blobs.exists(f"fields/{SHA}/original")
