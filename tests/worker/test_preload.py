"""A worker that loads the engine once: what it holds, and that jobs run in it all the same."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from redis.exceptions import ConnectionError as RedisConnectionError

from regnf_state.settings import Settings
from regnf_worker import main
from regnf_worker.main import PreloadError
from tests.worker.bench import bench

CODE = """
import os
for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):  # a test before may have set any of them
    os.environ[name] = "2"
from regnf_worker.main import preload
preload()
import torch
from regnf_core.schema import kinds, safe_format
assert safe_format._adapter.cache_info().currsize == len(kinds.KINDS), "a job would build what reads a description"
assert len(os.listdir("/proc/self/task")) == 1, "a fork would leave threads behind"
assert not torch.cuda.is_initialized(), "a CUDA context does not survive a fork"
child = os.fork()
if child == 0:
    square = torch.rand(600, 600) @ torch.rand(600, 600)
    assert torch.get_num_threads() == 2
    os._exit(0 if float(square.sum()) > 0 else 1)
raise SystemExit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


def test_nothing_that_is_loaded_starts_threads_and_a_child_computes() -> None:
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_what_starts_threads_is_refused() -> None:
    code = """
import threading
from regnf_worker import main
threading.Thread(target=threading.Event().wait, daemon=True).start()
main._MODULES = ()
main.preload()
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert "PreloadError" in ended.stderr
    assert ended.returncode == 1


def test_a_worker_holds_torch_before_its_first_job(tmp_path: Path) -> None:
    with bench(tmp_path) as table:
        worker = table.start_worker("regnf_worker.main")
        assert "libtorch" in Path(f"/proc/{worker.pid}/maps").read_text()


def test_threads_are_a_reason_to_start_without_only_where_nobody_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse() -> None:
        raise PreloadError("threads")

    started: list[tuple[list[str], dict[str, str]]] = []
    monkeypatch.setattr(main, "preload", refuse)
    monkeypatch.setattr(main.os, "execve", lambda _, arguments, environment: started.append((arguments, environment)))
    main._preload({"A": "b"})
    assert started == [(sys.orig_argv, {"A": "b", "REGNF_PRELOAD": "false"})]
    with pytest.raises(PreloadError):
        main._preload({"REGNF_PRELOAD": "true"})


def test_a_worker_whose_redis_does_not_run_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("redis.backoff.ExponentialWithJitterBackoff.compute", lambda *_: 0.0)
    monkeypatch.setattr(main, "configure_logging", lambda _: None)
    monkeypatch.setattr(main, "_preload", lambda _: pytest.fail("the engine was loaded first"))
    priority = os.nice(0)
    with pytest.raises(RedisConnectionError):
        main.run_worker(Settings(redis_url="redis://127.0.0.1:9/0"))
    assert os.nice(0) == priority


IMPORTS = """
import sys, os
from pathlib import Path
from regnf_worker.main import preload
preload()
from regnf_core.options import _adapter
assert _adapter.cache_info().currsize == 1
from regnf_core.geometry.box import OrientedBox
from tests.core.analytic import chair, chair_box, chair_pose, room
before = set(sys.modules)
child = os.fork()
if child == 0:
    from regnf_core.library import register
    from regnf_core.viewing.artifacts import write_pictures, write_result
    found = register(room(chair_pose()), chair(), chair_box(chair_pose()))
    write_result(found, Path(sys.argv[1]))
    write_pictures(found, Path(sys.argv[1]))
    print(*sorted(set(sys.modules) - before))
    sys.stdout.flush()
    os._exit(0)
raise SystemExit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


def test_a_job_imports_nothing(tmp_path: Path) -> None:
    command = [sys.executable, "-c", IMPORTS, str(tmp_path)]
    done = subprocess.run(command, check=True, timeout=300, capture_output=True, text=True)
    assert done.stdout.split() == []
