"""One attempt at a registration, against stores in memory."""

import pytest

from regnf_core.errors import CancelledError
from regnf_state.manifest import Manifest, read_manifest
from regnf_state.records import FieldRecord
from regnf_worker.artifacts import publish
from regnf_worker.attempt import Heartbeat, run_attempt
from regnf_worker.models import Context
from tests.stores import ShiftedRecords, WatchedQueue
from tests.worker.doubles import SHA, accept, ending, job
from tests.worker.tiny_engine import TinyEngine


def test_an_attempt_that_is_not_to_be_had_does_nothing(context: Context) -> None:
    accept(context)
    run_attempt(context, "j1", 2, "w", TinyEngine)
    run_attempt(context, "j9", 1, "w", TinyEngine)
    assert job(context).status == "accepted"


def test_a_rerun_returns_the_result_that_stands(context: Context) -> None:
    accept(context, "crash")
    published = Manifest("j1", 7, ())
    publish(context.blobs, published)
    run_attempt(context, "j1", 1, "w", TinyEngine)
    assert job(context).status == "successful"
    assert read_manifest(context.blobs, "j1") == published


def test_a_result_that_came_second_is_dropped(context: Context) -> None:
    accept(context)
    published = Manifest("j1", 7, ())

    class Slow(TinyEngine):
        def succeed(self, report: object) -> None:
            publish(context.blobs, published)

    run_attempt(context, "j1", 1, "w", Slow)
    assert job(context).status == "successful"
    assert list(context.blobs.list("jobs")) == ["jobs/j1/manifest.json"]


def test_a_deleted_field_is_told(context: Context) -> None:
    accept(context)
    context.records.delete_field(SHA)
    run_attempt(context, "j1", 1, "w", TinyEngine)
    assert ending(context) == ("failed", "FIELD_NOT_FOUND")


def test_fields_that_are_still_imported_send_the_job_back(context: Context) -> None:
    now = context.records.now()
    context.records.create_field(FieldRecord(SHA, "validating", 1, now, now))
    accept(context)
    run_attempt(context, "j1", 1, "w", TinyEngine)
    assert (job(context).status, job(context).attempt, job(context).requeues) == ("accepted", 2, 0)
    assert isinstance(context.queue, WatchedQueue)
    assert context.queue.registrations == [("j1", 2)]


def test_a_field_that_is_never_imported_fails_the_job_at_last(context: Context) -> None:
    now = context.records.now()
    context.records.create_field(FieldRecord(SHA, "validating", 1, now, now))
    accept(context)
    assert isinstance(context.records, ShiftedRecords)
    context.records.ahead_s += 2 * (120 + 90) + 1
    run_attempt(context, "j1", 1, "w", TinyEngine)
    assert ending(context) == ("failed", "FIELD_IMPORT_TIMEOUT")


def test_progress_is_written_a_few_times_a_second_but_every_phase(context: Context) -> None:
    accept(context)
    context.records.update_job("j1", 1, status="running")
    with Heartbeat(context.records, "j1", 1, 60) as heartbeat:
        for step in range(1000):
            heartbeat.report("optimizing", step / 1000)
        for phase in ("verifying", "exporting"):
            heartbeat.report(phase, 0.999)
    events = context.records.events("j1", None)
    assert [event.data["phase"] for event in events][-2:] == ["verifying", "exporting"]
    assert len(events) < 50


def test_a_job_hears_that_another_attempt_has_taken_over(context: Context) -> None:
    accept(context)
    context.records.update_job("j1", 1, status="running")
    context.records.requeue_job("j1", 1)
    with Heartbeat(context.records, "j1", 1, 60) as heartbeat, pytest.raises(CancelledError):
        heartbeat.report("optimizing", 0.5)
    assert heartbeat.superseded
