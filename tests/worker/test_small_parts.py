"""Problems, the kernel, temporary folders: the worker's small parts on their own."""

import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from regnf_state.blobs.base import StorageFullError
from regnf_state.reasons import problem_document
from regnf_state.redis.client import NoRedisError
from regnf_state.settings import Settings
from regnf_worker import kernel
from regnf_worker.job_limits import fault
from regnf_worker.kernel import Scratch
from regnf_worker.models import Context


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (MemoryError(), "OUT_OF_MEMORY"),
        (RuntimeError("CUDA out of memory. Tried to allocate"), "OUT_OF_MEMORY"),
        (StorageFullError(errno.ENOSPC, "full"), "STORAGE_FULL"),
        (OSError(errno.EDQUOT, "quota"), "STORAGE_FULL"),
        (OSError(errno.EIO, "/secret/path"), "INTERNAL"),
        (ValueError("secret"), "INTERNAL"),
    ],
)
def test_faults_have_reasons_and_tell_no_secrets(
    error: Exception, reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    found = fault(error, "job j1")
    assert found["reason"] == reason
    assert "secret" not in json.dumps(found)
    assert ("incident" in found) == (reason == "INTERNAL")
    assert f"job j1 failed, incident {found.get('incident', '')}" in caplog.text


def test_refusals_unknown_to_the_table_are_still_problems() -> None:
    found = problem_document("TENSOR_TOO_LARGE", "too large")
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
    one, other = first.of_job(), first.of_job()
    for folder in (one, other):
        (folder / "folder").mkdir(parents=True)
        (folder / "folder" / "file").write_bytes(b".")
        (folder / "link").symlink_to(tmp_path)
    first.drop(one)
    first.drop(one)
    assert sorted(path.name for path in first.folder.iterdir()) == [".lock", other.name]
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
    for module, code in (("regnf_worker.main", 2), ("regnf_cli.main", 3)):
        arguments = [sys.executable, "-m", module, *(["worker"] if code == 3 else [])]
        done = subprocess.run(arguments, env=environment, capture_output=True, text=True, timeout=60)
        assert done.returncode == code, done.stderr
        assert "REDIS_URL_MISSING" in done.stderr
        assert "Traceback" not in done.stderr
