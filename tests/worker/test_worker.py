"""A real worker on a real queue: how jobs end, and that the next one runs whatever befell the last."""

import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from regnf_core.options import RegistrationOptions
from regnf_state.manifest import read_manifest
from regnf_state.records import FieldRecord
from tests.processes import alive, children_of
from tests.worker.bench import OBJECT, SCENE, Bench, bench, eventually


@pytest.fixture
def table(tmp_path: Path) -> Iterator[Bench]:
    with bench(tmp_path, shutdown_grace_s=0) as made:
        made.add_ready_fields()
        yield made


def assert_next_job_runs(table: Bench) -> None:
    table.submit("succeed", "next")
    assert table.finished("next").status == "successful"
    eventually(lambda: not table.leftovers(), "a clean scratch folder")


def test_a_job_succeeds(table: Bench) -> None:
    worker = table.start_worker()
    table.submit("succeed")
    done = table.finished()
    assert (done.status, done.progress, done.attempt, done.error) == ("successful", 1.0, 1, None)
    assert done.engine == {"version": "tiny", "device": "none"}
    manifest = read_manifest(table.context.blobs, "j1")
    assert manifest is not None
    assert manifest.attempt == 1
    assert [(one.name, one.media_type) for one in manifest.artifacts] == [
        ("result.json", "application/json"),
        ("aligned.ply", "application/octet-stream"),
    ]
    with table.context.blobs.open("jobs/j1/1/aligned.ply") as file:
        assert file.read() == b"ab"
    with table.context.blobs.open("jobs/j1/1/result.json") as file:
        assert json.load(file)["pid"] not in (worker.pid, os.getpid()), "jobs have a process of their own"
    phases = [event.data["phase"] for event in table.context.records.events("j1", None)]
    assert phases == [None, "loading", "sampling", "optimizing", "exporting", "exporting"]
    eventually(lambda: not table.redis.keys("rq:job:*"), "the queue's forgetting the job")
    assert_next_job_runs(table)


def test_a_job_succeeds_on_every_kind_of_redis(tmp_path: Path, redis_url: str) -> None:
    with bench(tmp_path, redis_url=redis_url) as table:
        table.redis.flushall()
        table.add_ready_fields()
        table.start_worker()
        table.submit("succeed")
        assert table.finished().status == "successful"
        assert_next_job_runs(table)


def test_the_parent_of_a_worker_told_so_never_loads_torch(table: Bench) -> None:
    worker = table.start_worker("regnf_worker.main", preload=False)
    maps = Path(f"/proc/{worker.pid}/maps").read_text()
    assert "/python" in maps
    assert "libtorch" not in maps
    assert "open3d" not in maps


@pytest.mark.parametrize(
    ("do", "reason", "status"),
    [("refuse", "NO_SURFACE_IN_DETECTION", 422), ("crash", "INTERNAL", 500), ("exhaust", "OUT_OF_MEMORY", 500)],
)
def test_a_job_fails_with_its_reason(table: Bench, do: str, reason: str, status: int) -> None:
    table.start_worker()
    table.submit(do)
    failed = table.finished()
    assert failed.status == "failed"
    assert failed.error is not None
    assert (failed.error["reason"], failed.error["status"]) == (reason, status)
    assert failed.error.keys() >= {"type", "title", "detail"}
    assert "secret" not in json.dumps(failed.error)
    assert list(table.context.blobs.list("jobs")) == []
    if reason == "INTERNAL":
        assert failed.error["incident"] in table.log()
        assert "secret value 42" in table.log()
    assert_next_job_runs(table)


def test_a_job_that_crashes_its_process_is_lost_and_its_worker_goes_on(table: Bench) -> None:
    """Killed from outside it would get a second chance; what it does to itself it would do again."""
    worker = table.start_worker()
    table.submit("segfault")
    failed = table.finished()
    assert failed.error is not None
    assert (failed.status, failed.error["reason"], failed.attempt) == ("failed", "WORKER_LOST", 1)
    assert worker.poll() is None
    assert_next_job_runs(table)


def test_what_a_killed_process_was_writing_goes_with_it(table: Bench) -> None:
    table.start_worker()
    table.submit("die_while_writing")
    assert table.finished().status == "failed"
    left = table.context.settings.blob_dir / ".tmp"
    eventually(lambda: not list(left.iterdir()), "no unfinished file")
    assert_next_job_runs(table)


def test_a_job_that_ends_without_a_word_is_run_again_once(table: Bench) -> None:
    table.start_worker()
    table.submit("leave")
    done = table.finished()
    assert (done.status, done.attempt, done.requeues) == ("successful", 2, 1)


@pytest.mark.parametrize("do", ["iterate", "hang"])
def test_a_running_job_is_cancelled(table: Bench, do: str) -> None:
    table.start_worker()
    table.submit(do)
    table.reaches("optimizing" if do == "iterate" else "sampling")
    table.context.records.request_cancel("j1")
    table.context.queue.stop("j1", 1)
    assert table.finished().status == "dismissed"
    assert_next_job_runs(table)


@pytest.mark.parametrize("do", ["iterate", "hang"])
def test_a_cancelled_job_stops_though_the_stop_command_is_lost(table: Bench, do: str) -> None:
    table.start_worker()
    table.submit(do)
    table.reaches("optimizing" if do == "iterate" else "sampling")
    table.context.records.request_cancel("j1")
    assert table.finished().status == "dismissed"
    assert_next_job_runs(table)


def test_a_waiting_job_is_cancelled_and_leaves_the_queue(table: Bench) -> None:
    table.submit("succeed")
    assert table.context.queue.holds_registration("j1", 1)
    table.context.records.request_cancel("j1")
    table.context.queue.stop("j1", 1)
    assert not table.context.queue.holds_registration("j1", 1)
    table.start_worker()
    assert_next_job_runs(table)
    assert table.job().status == "dismissed"
    assert table.job().started is None


@pytest.mark.parametrize("do", ["iterate", "hang"])
def test_a_job_that_takes_too_long_is_ended(table: Bench, do: str) -> None:
    table.start_worker(job_timeout_s=1)
    table.submit(do)
    failed = table.finished()
    assert failed.error is not None
    assert (failed.status, failed.error["reason"]) == ("failed", "JOB_TIMEOUT")
    assert failed.error["detail"] == "the job took longer than the allowed 1 s (REGNF_JOB_TIMEOUT_S)"
    assert_next_job_runs(table)


def test_a_killed_worker_takes_its_job_along(table: Bench) -> None:
    worker = table.start_worker()
    table.submit("hang")
    table.reaches("sampling")
    (child,) = children_of(worker.pid)
    assert alive(child)
    worker.kill()
    worker.wait()
    eventually(lambda: not alive(child), "the child's end")
    assert table.job().status == "running", "nobody is left to say otherwise; the reaper will"
    assert table.leftovers() == ["job-" + name.removeprefix("job-") for name in table.leftovers()] != []
    table.start_worker()
    assert table.leftovers() == [], "the next worker sweeps what the dead one left"


def test_a_worker_told_to_stop_gives_its_job_back(table: Bench) -> None:
    worker = table.start_worker()
    table.submit("hang")
    table.reaches("sampling")
    worker.send_signal(signal.SIGTERM)
    assert worker.wait(30) == 0
    back = table.job()
    assert (back.status, back.attempt, back.requeues) == ("accepted", 2, 0)
    assert table.context.queue.holds_registration("j1", 2)
    assert table.context.queue.live_workers() == 0


def test_an_idle_worker_stops_at_once_and_leaves_nothing(table: Bench) -> None:
    for number in (signal.SIGTERM, signal.SIGINT):
        worker = table.start_worker()
        worker.send_signal(number)
        assert worker.wait(30) == 0
    assert [path for path in table.context.settings.scratch_dir.iterdir() if path.is_dir()] == []


def upload(table: Bench, sha256: str, data: bytes) -> None:
    now = table.context.records.now()
    table.context.blobs.put(f"fields/{sha256}/original", data)
    record, created = table.context.records.create_field(FieldRecord(sha256, "validating", len(data), now, now))
    assert created
    table.context.queue.enqueue_import(sha256, record.attempt)


def field_state(table: Bench, sha256: str) -> FieldRecord:
    def ended() -> FieldRecord | None:
        record = table.context.records.get_field(sha256)
        return record if record is not None and record.state != "validating" else None

    return eventually(ended, table.log)


def test_imports_and_registrations_that_wait_for_them(tmp_path: Path) -> None:
    with bench(tmp_path) as table:
        table.submit("succeed")
        upload(table, SCENE, b"s")
        upload(table, OBJECT, b"o")
        table.start_worker()
        assert table.finished().status == "successful", table.job().error
        with table.context.blobs.open("jobs/j1/1/aligned.ply") as file:
            assert file.read() == b"so"
        ready = field_state(table, SCENE)
        assert (ready.state, ready.report["family"]) == ("ready", "tiny")
        assert list(table.context.blobs.list(f"fields/{SCENE}")) == [
            f"fields/{SCENE}/field.safetensors",
            f"fields/{SCENE}/report.json",
        ]


@pytest.mark.parametrize(("data", "modeled"), [(b"object", True), (b"air", False)])
def test_what_becomes_an_entry_while_its_import_ends_is_modeled_once(
    tmp_path: Path, data: bytes, modeled: bool
) -> None:
    with bench(tmp_path) as table:
        table.add_ready_fields("else")
        upload(table, SCENE, data)
        table.start_worker()
        imports = table.context.settings.state_dir / "imports"
        eventually(lambda: imports.exists() and len(imports.read_text().split()) == 2, table.log)
        eventually(lambda: not table.context.queue.holds_import(SCENE, 1), table.log)
        table.submit("succeed", owner="else")
        assert table.finished().status == "successful", table.log()
        assert imports.read_text().split() == [SCENE, SCENE]
        found = table.context.records.get_field(SCENE)
        assert found is not None
        assert found.library is not None
        assert (found.symmetry is not None) is modeled


def test_a_registration_of_a_rejected_field_fails(tmp_path: Path) -> None:
    with bench(tmp_path) as table:
        upload(table, SCENE, b"die")
        upload(table, OBJECT, b"o")
        table.submit("succeed")
        table.start_worker()
        failed = table.finished()
        assert failed.error is not None
        assert failed.error["reason"] == "FIELD_REJECTED"
        rejected = field_state(table, SCENE)
        assert rejected.error is not None
        assert (rejected.state, rejected.error["reason"]) == ("rejected", "WORKER_LOST")
        assert list(table.context.blobs.list(f"fields/{SCENE}")) == []
        upload(table, SCENE, b"s")
        assert field_state(table, SCENE).attempt == 3
        table.submit("succeed")
        assert table.finished().status == "successful"


def test_the_real_gate_rejects_what_is_no_field(tmp_path: Path) -> None:
    with bench(tmp_path) as table:
        from regnf_state.redis.queue import JobQueue

        now = table.context.records.now()
        table.context.blobs.put(f"fields/{SCENE}/original", b"no field at all")
        table.context.records.create_field(FieldRecord(SCENE, "validating", 15, now, now))
        JobQueue(table.redis).enqueue_import(SCENE)
        table.start_worker("regnf_worker.main")
        rejected = field_state(table, SCENE)
        assert rejected.error is not None
        assert (rejected.state, rejected.error["reason"]) == ("rejected", "FORMAT_NOT_RECOGNIZED")
        assert list(table.context.blobs.list("fields")) == []
        assert "Traceback" not in table.log()


@pytest.mark.parametrize("pictures", [True, False])
def test_a_search_makes_pictures_where_they_are_wanted(table: Bench, pictures: bool) -> None:
    table.start_worker()
    table.submit("succeed", candidates=(OBJECT, SCENE), options=RegistrationOptions(), pictures=pictures)
    assert table.finished().status == "successful", table.log()
    manifest = read_manifest(table.context.blobs, "j1")
    assert manifest is not None
    named = {*manifest.pending, *(one.name for one in manifest.artifacts)}
    assert named == ({"result.json", "preview.png"} if pictures else {"result.json"})
    eventually(lambda: not read_manifest(table.context.blobs, "j1").pending, "all pictures")  # type: ignore[union-attr]


BEGINNINGS = [
    ("os:setpgrp", "OSError"),
    ("regnf_worker.job_limits:JobLimits.hold_here", "ValueError"),
    ("regnf_worker.kernel:Scratch.use", "OSError"),
    ("random:seed", "KeyboardInterrupt"),
]
"""What a job's process does before its job."""


@pytest.mark.parametrize(
    ("breaks", "raises", "reason"),
    [*((*each, "INTERNAL") for each in BEGINNINGS), ("pathlib:Path.mkdir", "OSError", "STORAGE_FULL")],
)
def test_a_process_that_cannot_begin_takes_nothing_with_it(table: Bench, breaks: str, raises: str, reason: str) -> None:
    """The worker, its folder, its registration and the pictures of the job before stay; the job says what is wrong."""
    table.environment |= {"TINY_BREAKS": breaks, "TINY_RAISES": raises}
    worker = table.start_worker()
    table.submit("draw_for_ever", "drawn")
    assert table.finished("drawn").status == "successful"
    (drawing,) = children_of(worker.pid)
    folders = sorted(table.context.settings.scratch_dir.glob("[!.]*"))
    (table.context.settings.state_dir / "break").touch()
    table.submit("succeed")
    failed = table.finished()
    assert (failed.status, (failed.error or {}).get("reason")) == ("failed", reason), table.log()
    assert alive(drawing)
    assert worker.poll() is None
    assert sorted(table.context.settings.scratch_dir.glob("[!.]*")) == folders
    assert table.context.queue.live_workers() == 1
    manifest = read_manifest(table.context.blobs, "drawn")
    assert manifest is not None
    assert (manifest.pending, manifest.missing) == (("preview.png",), ())
    (table.context.settings.state_dir / "break").unlink()
    table.submit("succeed", "next")
    assert table.finished("next").status == "successful"
    assert alive(drawing)
