"""The worker's small parts on their own."""

import errno
import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from rq.timeouts import JobTimeoutException

from regnf_core.errors import CancelledError
from service.blobs import StorageFullError
from service.memory import InMemoryBlobStore, InMemoryJobQueue, InMemoryRecordStore
from service.records import FieldRecord, JobRecord
from service.settings import Settings
from tests.worker.tiny_engine import TinyEngine, tiny_importer
from worker import kernel
from worker.artifacts import discard_others, publish, read_manifest, store_artifacts
from worker.context import Context, NoRedisError
from worker.imports import run_import_attempt
from worker.problems import fault, problem
from worker.pulse import Pulse
from worker.registration import run_attempt
from worker.scratch import Scratch
from worker.settle import HorseEnd, settle_import, settle_registration

SHA = "a" * 64


@pytest.fixture
def context(tmp_path: Path) -> Context:
    settings = Settings(state_dir=tmp_path, heartbeat_s=0.05)
    return Context(settings, InMemoryRecordStore(), InMemoryBlobStore(), InMemoryJobQueue())


def accept(context: Context, do: str = "succeed") -> None:
    now = context.records.now()
    if context.records.get_field(SHA) is None:
        context.records.create_field(FieldRecord(SHA, "ready", 1, now, now))
        context.blobs.put(f"fields/{SHA}/field.safetensors", b"f")
    request = {"scene": SHA, "object": SHA, "options": {"do": do}}
    context.records.create_job(JobRecord("j1", "registration", "accepted", request, {}, now, now), 10)


def job(context: Context) -> JobRecord:
    record = context.records.get_job("j1")
    assert record is not None
    return record


# artifacts


def test_a_manifest_says_what_lies_where(tmp_path: Path) -> None:
    blobs = InMemoryBlobStore()
    (tmp_path / "result.json").write_bytes(b"{}")
    (tmp_path / "trace.unknown").write_bytes(b"xyz")
    manifest = store_artifacts(blobs, "j1", 3, tmp_path, ["result.json", "trace.unknown"])
    assert read_manifest(blobs, "j1") is None, "stored is not yet published"
    assert publish(blobs, "j1", manifest)
    assert read_manifest(blobs, "j1") == manifest
    assert manifest["attempt"] == 3
    assert manifest["artifacts"][1] == {
        "name": "trace.unknown",
        "bytes": 3,
        "media_type": "application/octet-stream",
        "sha256": hashlib.sha256(b"xyz").hexdigest(),
    }


def test_a_job_has_one_result() -> None:
    blobs = InMemoryBlobStore()
    first = {"attempt": 1, "artifacts": [{"name": "x"}]}
    assert publish(blobs, "j1", first)
    assert not publish(blobs, "j1", {"attempt": 2, "artifacts": []})
    assert read_manifest(blobs, "j1") == first
    for key in ("jobs/j1/1/x", "jobs/j1/1/old", "jobs/j1/2/x", "jobs/j10/2/x"):
        blobs.put(key, b".")
    discard_others(blobs, "j1", first)
    assert sorted(blobs.blobs) == ["jobs/j1/1/x", "jobs/j1/manifest.json", "jobs/j10/2/x"]


# a registration against doubles


def test_an_attempt_that_is_not_to_be_had_does_nothing(context: Context) -> None:
    accept(context)
    run_attempt(context, "j1", 2, "w", TinyEngine)
    run_attempt(context, "j9", 1, "w", TinyEngine)
    assert job(context).status == "accepted"


def test_a_rerun_returns_the_result_that_stands(context: Context) -> None:
    accept(context, "crash")
    standing = {"attempt": 7, "artifacts": []}
    publish(context.blobs, "j1", standing)
    run_attempt(context, "j1", 1, "w", TinyEngine)
    assert job(context).status == "successful"
    assert read_manifest(context.blobs, "j1") == standing


def test_a_result_that_came_second_is_dropped(context: Context) -> None:
    accept(context)
    standing = {"attempt": 7, "artifacts": []}

    class Slow(TinyEngine):
        def succeed(self, report: object) -> None:
            publish(context.blobs, "j1", standing)

    run_attempt(context, "j1", 1, "w", Slow)
    assert job(context).status == "successful"
    assert list(context.blobs.list("jobs")) == ["jobs/j1/manifest.json"]


def test_a_deleted_field_is_told(context: Context) -> None:
    accept(context)
    context.records.delete_field(SHA)
    run_attempt(context, "j1", 1, "w", TinyEngine)
    error = job(context).error
    assert error is not None
    assert error["reason"] == "FIELD_NOT_FOUND"


def test_fields_that_are_still_imported_send_the_job_back(context: Context, monkeypatch: pytest.MonkeyPatch) -> None:
    now = context.records.now()
    context.records.create_field(FieldRecord(SHA, "validating", 1, now, now))
    accept(context)
    monkeypatch.setattr("worker.fields._WAIT_BEFORE_GIVING_BACK_S", 0.0)
    run_attempt(context, "j1", 1, "w", TinyEngine)
    assert (job(context).status, job(context).attempt, job(context).requeues) == ("accepted", 2, 0)
    assert isinstance(context.queue, InMemoryJobQueue)
    assert context.queue.registrations == [("j1", 2)]


def test_a_field_that_is_never_imported_fails_the_job_at_last(tmp_path: Path) -> None:
    time = [1000.0]
    records = InMemoryRecordStore(clock=lambda: time[0])
    context = Context(Settings(state_dir=tmp_path), records, InMemoryBlobStore(), InMemoryJobQueue())
    records.create_field(FieldRecord(SHA, "validating", 1, 1000.0, 1000.0))
    accept(context)
    time[0] += 2 * (120 + 90) + 1
    run_attempt(context, "j1", 1, "w", TinyEngine)
    error = job(context).error
    assert error is not None
    assert error["reason"] == "FIELD_IMPORT_TIMEOUT"


def test_progress_is_written_a_few_times_a_second_but_every_phase(context: Context) -> None:
    accept(context)
    context.records.update_job("j1", 1, status="running")
    with Pulse(context.records, "j1", 1, 60) as pulse:
        for step in range(1000):
            pulse.report("optimising", step / 1000)
        for phase in ("verifying", "exporting"):
            pulse.report(phase, 0.999)
    events = context.records.events("j1", None, 0)
    assert [event.data["phase"] for event in events][-2:] == ["verifying", "exporting"]
    assert len(events) < 50


def test_a_job_hears_that_another_attempt_has_taken_over(context: Context) -> None:
    accept(context)
    context.records.update_job("j1", 1, status="running")
    context.records.requeue_job("j1", 1)
    with Pulse(context.records, "j1", 1, 60) as pulse, pytest.raises(CancelledError):
        pulse.report("optimising", 0.5)
    assert pulse.superseded


# what outlives a process


@pytest.mark.parametrize(
    ("end", "reason"),
    [
        (HorseEnd(signal=11), "WORKER_LOST"),
        (HorseEnd(signal=11, out_of_memory=True), "WORKER_LOST"),
        (HorseEnd(signal=9, out_of_memory=True), "OUT_OF_MEMORY"),
        (HorseEnd(signal=9, late=True, out_of_memory=True), "JOB_TIMEOUT"),
        (HorseEnd(late=True), "JOB_TIMEOUT"),
    ],
)
@pytest.mark.parametrize("claimed", [True, False])
def test_how_a_process_ended_is_how_its_job_failed(context: Context, end: HorseEnd, reason: str, claimed: bool) -> None:
    accept(context)
    if claimed:
        context.records.update_job("j1", 1, status="running", worker="w")
    context.blobs.put("jobs/j1/1/half", b".")
    settle_registration(context, "j1", 1, "w", end)
    error = job(context).error
    assert error is not None
    assert (job(context).status, error["reason"]) == ("failed", reason)
    assert list(context.blobs.list("jobs")) == []


@pytest.mark.parametrize(
    ("end", "reason"),
    [(HorseEnd(), "INTERNAL"), (HorseEnd(signal=9), "WORKER_LOST"), (HorseEnd(signal=15), "WORKER_LOST")],
)
def test_a_process_that_vanishes_is_given_a_second_chance_and_no_third(
    context: Context, end: HorseEnd, reason: str
) -> None:
    accept(context)
    context.blobs.put("jobs/j1/1/half", b".")
    settle_registration(context, "j1", 1, "w", end)
    assert (job(context).status, job(context).attempt, job(context).requeues) == ("accepted", 2, 1)
    assert context.queue.holds_registration("j1", 2)
    settle_registration(context, "j1", 2, "w", end)
    error = job(context).error
    assert error is not None
    assert (job(context).status, error["reason"]) == ("failed", reason)
    assert reason == "WORKER_LOST" or "request" not in error["detail"], "no request failed here"
    assert list(context.blobs.list("jobs")) == []


def test_somebody_elses_job_is_left_alone(context: Context) -> None:
    accept(context)
    running = context.records.update_job("j1", 1, status="running", worker="other")
    settle_registration(context, "j1", 1, "w", HorseEnd(signal=9))
    assert job(context) == running


def test_a_killed_process_whose_result_stands_has_succeeded(context: Context) -> None:
    accept(context)
    context.records.update_job("j1", 1, status="running", worker="w")
    publish(context.blobs, "j1", {"attempt": 1, "artifacts": []})
    settle_registration(context, "j1", 1, "w", HorseEnd(signal=9))
    assert job(context).status == "successful"


def test_a_killed_process_whose_job_was_cancelled(context: Context) -> None:
    accept(context)
    context.records.update_job("j1", 1, status="running", worker="w")
    context.records.request_cancel("j1")
    settle_registration(context, "j1", 1, "w", HorseEnd(signal=9))
    assert job(context).status == "dismissed"


# imports


def begin_import(context: Context, data: bytes = b"f") -> None:
    now = context.records.now()
    context.records.create_field(FieldRecord(SHA, "validating", 1, now, now))
    context.blobs.put(f"fields/{SHA}/original", data)


def field(context: Context) -> FieldRecord:
    record = context.records.get_field(SHA)
    assert record is not None
    return record


def test_of_two_deliveries_of_an_import_one_does_the_work(context: Context) -> None:
    begin_import(context)
    context.records.remember(f"import:{SHA}:1", "other", 60)
    run_import_attempt(context, SHA, 1, "w", tiny_importer)
    settle_import(context, SHA, 1, "w", HorseEnd(signal=9))
    assert field(context).state == "validating"
    run_import_attempt(context, SHA, 1, "other", tiny_importer)
    assert field(context).state == "ready"


def test_an_import_that_died_after_its_work_is_not_done_again(context: Context) -> None:
    begin_import(context)
    context.blobs.put(
        f"fields/{SHA}/report.json", json.dumps({"description": {}, "report": {"family": "found before"}}).encode()
    )
    context.blobs.delete(f"fields/{SHA}/original")
    run_import_attempt(context, SHA, 1, "w", tiny_importer)
    assert (field(context).state, field(context).report) == ("ready", {"family": "found before"})


@pytest.mark.parametrize(
    ("end", "reason"), [(HorseEnd(signal=11), "WORKER_LOST"), (HorseEnd(late=True, signal=9), "IMPORT_TIMEOUT")]
)
def test_a_killed_import_rejects_its_field(context: Context, end: HorseEnd, reason: str) -> None:
    begin_import(context)
    settle_import(context, SHA, 1, "w", end)
    error = field(context).error
    assert error is not None
    assert (field(context).state, error["reason"]) == ("rejected", reason)
    assert list(context.blobs.list("")) == []


@pytest.mark.parametrize("given_back", [True, False])
def test_an_import_given_back_or_killed_starts_anew(context: Context, given_back: bool) -> None:
    begin_import(context)
    settle_import(context, SHA, 1, "w", HorseEnd(signal=9, given_back=given_back))
    requeues = 0 if given_back else 1
    assert (field(context).state, field(context).attempt, field(context).requeues) == ("validating", 2, requeues)
    assert context.blobs.exists(f"fields/{SHA}/original")


def test_a_field_deleted_while_it_is_imported_leaves_nothing(context: Context) -> None:
    begin_import(context)

    def importer(upload: Path, folder: Path, description: dict[str, object]) -> dict[str, object]:
        context.records.delete_field(SHA)
        return tiny_importer(upload, folder, description)

    run_import_attempt(context, SHA, 1, "w", importer)
    assert list(context.blobs.list("")) == []


def test_an_upload_after_a_deletion_owes_nothing_to_the_import_before_it(context: Context) -> None:
    begin_import(context)

    def importer(upload: Path, folder: Path, description: dict[str, object]) -> dict[str, object]:
        context.records.delete_field(SHA)
        begin_import(context)
        return tiny_importer(upload, folder, description)

    run_import_attempt(context, SHA, 1, "w", importer)
    settle_import(context, SHA, 1, "w", HorseEnd())
    assert field(context).state == "validating"
    assert list(context.blobs.list("")) == [f"fields/{SHA}/original"]
    run_import_attempt(context, SHA, field(context).attempt, "other", tiny_importer)
    assert field(context).state == "ready"


def test_a_report_for_another_description_does_not_count(context: Context) -> None:
    begin_import(context)
    standing = {"description": {"contraction": "linf"}, "report": {"family": "found before"}}
    context.blobs.put(f"fields/{SHA}/report.json", json.dumps(standing).encode())
    run_import_attempt(context, SHA, 1, "w", tiny_importer)
    assert (field(context).state, field(context).report) == ("ready", {"family": "tiny"})


# problems, the kernel, folders


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (JobTimeoutException(), "JOB_TIMEOUT"),
        (MemoryError(), "OUT_OF_MEMORY"),
        (RuntimeError("CUDA out of memory. Tried to allocate"), "OUT_OF_MEMORY"),
        (StorageFullError(errno.ENOSPC, "full"), "STORAGE_FULL"),
        (OSError(errno.EDQUOT, "quota"), "STORAGE_FULL"),
        (OSError(errno.EIO, "/secret/path"), "INTERNAL"),
        (ValueError("secret"), "INTERNAL"),
    ],
)
def test_faults_have_reasons_and_tell_no_secrets(error: Exception, reason: str) -> None:
    found = fault(error, "0123")
    assert found["reason"] == reason
    assert "secret" not in json.dumps(found)
    assert found.get("incident") == ("0123" if reason == "INTERNAL" else None)


def test_refusals_unknown_to_the_table_are_still_problems() -> None:
    found = problem("TENSOR_TOO_LARGE", "too large")
    assert (found["status"], found["title"], found["detail"]) == (422, "Tensor too large", "too large")


def test_cores_are_shared_among_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)))
    for threads, workers, given, expected in (
        (None, 2, {}, "4"),
        (None, 16, {}, "1"),
        (None, 0, {}, "8"),
        (3, 2, {"OMP_NUM_THREADS": "7"}, "3"),
        (None, 2, {"OMP_NUM_THREADS": "7"}, "7"),
    ):
        environment = dict(given)
        kernel.share_cores(environment, threads, workers)
        assert environment["OMP_NUM_THREADS"] == expected
        assert environment["OMP_WAIT_POLICY"] == "PASSIVE"


def test_oom_kills_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "vmstat").write_text("pgfault 12\noom_kill 3\n")
    (tmp_path / "events").write_text("oom 9\noom_kill 4\noom_group_kill 5\n")
    counters = (str(tmp_path / "vmstat"), str(tmp_path / "missing"), str(tmp_path / "events"))
    monkeypatch.setattr(kernel, "_COUNTERS", counters)
    assert kernel.oom_kills() == 7


def test_a_scratch_folder_is_emptied_and_goes_with_its_owner(tmp_path: Path) -> None:
    first, second = Scratch(tmp_path), Scratch(tmp_path)
    (first.folder / "folder").mkdir()
    (first.folder / "folder" / "file").write_bytes(b".")
    (first.folder / "link").symlink_to(tmp_path)
    first.empty()
    assert [path.name for path in first.folder.iterdir()] == [".lock"]
    Scratch(tmp_path).remove()
    assert first.folder.is_dir(), "its owner lives"
    first._lock.close()  # what the kernel does when the owner is killed
    Scratch(tmp_path).remove()
    assert not first.folder.exists()
    assert second.folder.is_dir()
    second.remove()
    assert [path.name for path in tmp_path.iterdir()] == [".lock"]


def test_a_worker_without_redis_says_so() -> None:
    with pytest.raises(NoRedisError):
        Context.from_settings(Settings(redis_url=None))
    environment = {name: value for name, value in os.environ.items() if not name.startswith("REGNF_")}
    for module, code in (("worker.main", 2), ("regnf_cli.main", 3)):
        arguments = [sys.executable, "-m", module, *(["worker"] if code == 3 else [])]
        done = subprocess.run(arguments, env=environment, capture_output=True, text=True, timeout=60)
        assert done.returncode == code, done.stderr
        assert "REDIS_URL_MISSING" in done.stderr
        assert "Traceback" not in done.stderr
