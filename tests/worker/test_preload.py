"""A worker that loads the engine once: what it holds, and that jobs run in it all the same."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from tests.worker.bench import bench

CODE = """
import os
os.environ["OMP_NUM_THREADS"] = "2"
os.environ["OPENBLAS_NUM_THREADS"] = "2"
from regnf_worker.preload import preload
preload()
import torch
assert len(os.listdir("/proc/self/task")) == 1, "a fork would leave threads behind"
assert not torch.cuda.is_initialized(), "a CUDA context does not survive a fork"
child = os.fork()
if child == 0:
    square = torch.rand(600, 600) @ torch.rand(600, 600)
    assert torch.get_num_threads() == 2
    os._exit(0 if float(square.sum()) > 0 else 1)
raise SystemExit(os.waitpid(child, 0)[1])
"""


def test_nothing_that_is_loaded_starts_threads_and_a_child_computes() -> None:
    subprocess.run([sys.executable, "-c", CODE], check=True, timeout=120)


def test_what_starts_threads_is_refused() -> None:
    code = """
import threading
from regnf_worker import preload
threading.Thread(target=threading.Event().wait, daemon=True).start()
preload._MODULES = ()
preload.preload()
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert "PreloadError" in ended.stderr
    assert ended.returncode == 1


def test_a_worker_told_to_holds_torch_before_its_first_job(tmp_path: Path) -> None:
    with bench(tmp_path) as table:
        worker = table.start_worker("regnf_worker.main", preload=True)
        assert "libtorch" in Path(f"/proc/{worker.pid}/maps").read_text()
