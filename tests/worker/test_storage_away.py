"""Storage that stays away longer than the worker's patience: the work is done once more, nobody is told a fault."""

import errno
import os
from dataclasses import replace
from pathlib import Path

import pytest
from redis import Redis

from regnf_state.blobs.base import StorageUnavailableError
from regnf_state.blobs.local import LocalBlobWriter
from regnf_state.settings import Settings
from regnf_worker import kernel
from regnf_worker.attempt import run_attempt
from regnf_worker.imports import run_import_attempt
from regnf_worker.kernel import Scratch
from regnf_worker.models import Context
from regnf_worker.settle import ChildExit, settle_import, settle_registration
from tests.stores import HeldBlobs
from tests.worker.doubles import SHA, accept, begin_import, context_over, ending, field, job
from tests.worker.tiny_engine import Report, TinyEngine, tiny_importer


class AwayStore(HeldBlobs):
    """Takes nothing while it is away."""

    away = False

    def writer(self) -> LocalBlobWriter:
        if self.away:
            raise StorageUnavailableError("away")
        return super().writer()


@pytest.fixture
def store(tmp_path: Path) -> AwayStore:
    return AwayStore(tmp_path / "blobs")


@pytest.fixture
def context(tmp_path: Path, any_redis: Redis, store: AwayStore) -> Context:
    settings = Settings(state_dir=tmp_path, heartbeat_s=0.05)
    return replace(context_over(any_redis, settings), blobs=store)


def test_a_job_whose_result_cannot_be_stored_is_run_again(context: Context, store: AwayStore) -> None:
    accept(context)
    store.away = True
    with pytest.raises(StorageUnavailableError):
        run_attempt(context, "j1", 1, "w", TinyEngine)
    assert ending(context) == ("running", None)
    store.away = False
    settle_registration(context, "j1", 1, "w", ChildExit())
    run_attempt(context, "j1", 2, "w", TinyEngine)
    assert (job(context).status, job(context).attempt) == ("successful", 2)


def test_an_import_whose_field_cannot_be_stored_is_done_again_once(context: Context, store: AwayStore) -> None:
    begin_import(context)
    store.away = True
    states = []
    for attempt in (1, 2):
        with pytest.raises(StorageUnavailableError):
            run_import_attempt(context, SHA, attempt, "w", tiny_importer)
        settle_import(context, SHA, attempt, "w", ChildExit())
        record = field(context)
        states.append((record.state, record.attempt, (record.error or {}).get("reason")))
    assert states == [("validating", 2, None), ("rejected", 2, "INTERNAL")]
    assert context.queue.holds_import(SHA, 2)


def test_work_in_a_child_changes_nothing_here(tmp_path: Path) -> None:
    parent = os.getpid()

    def tell() -> None:
        (tmp_path / "pid").write_text(str(os.getpid()))

    assert kernel.in_child(tell)
    assert int((tmp_path / "pid").read_text()) != parent
    assert not kernel.in_child(lambda: os.kill(os.getpid(), 9))


class FileLosingEngine(TinyEngine):
    """Finds a field's file gone, as on a volume that is no longer mounted."""

    def succeed(self, report: Report) -> None:
        raise FileNotFoundError(errno.ENOENT, "No such file or directory")


def test_a_job_whose_files_are_gone_is_run_again(context: Context, store: AwayStore) -> None:
    accept(context)
    with pytest.raises(FileNotFoundError):
        run_attempt(context, "j1", 1, "w", FileLosingEngine)
    settle_registration(context, "j1", 1, "w", ChildExit())
    again = job(context)
    assert (again.status, again.attempt, again.requeues) == ("accepted", 2, 1)


def test_a_worker_whose_temporary_files_are_out_of_reach_goes_on(tmp_path: Path) -> None:
    scratch = Scratch(tmp_path / "scratch")
    (tmp_path / "scratch").rename(tmp_path / "elsewhere")
    scratch.drop(scratch.of_job())
    assert not (tmp_path / "scratch").exists()
    (tmp_path / "elsewhere").rename(tmp_path / "scratch")
    scratch.remove()


def test_what_a_job_left_on_a_volume_that_was_away_goes_once_it_is_back(tmp_path: Path) -> None:
    volume, elsewhere = tmp_path / "volume", tmp_path / "elsewhere"
    scratch = Scratch(volume)
    folder = scratch.of_job()
    folder.mkdir()
    (folder / "file").write_bytes(b"left")
    volume.rename(elsewhere)
    scratch.drop(folder)
    assert scratch.drop_left(), "it is not forgotten"
    elsewhere.rename(volume)
    assert folder.exists()
    assert not scratch.drop_left()
    assert not folder.exists()
    scratch.remove()
