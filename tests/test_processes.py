"""Which processes there are: those below this one, those that have ended, and those that nobody has waited for."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import psutil
import pytest

from tests.processes import alive, children_of, command_of, descendants_of, processor_seconds
from tests.worker.bench import eventually

PARENT = "import subprocess, sys; subprocess.run(['/bin/sleep', '300'])"


def test_the_processes_below_one() -> None:
    parent = subprocess.Popen([sys.executable, "-c", PARENT], start_new_session=True)
    try:
        (sleep,) = eventually(lambda: [pid for pid in children_of(parent.pid) if is_sleep(pid)], "the sleep")
        assert children_of(sleep) == []
        assert {parent.pid, sleep} <= set(descendants_of(os.getpid()))
        assert parent.pid in children_of(os.getpid())
        assert sleep not in children_of(os.getpid()), "it is a grandchild"
        parent.kill()
        eventually(lambda: not alive(parent.pid), "its end")
        assert parent.pid in children_of(os.getpid()), "nobody has waited for it"
        parent.wait()
        assert parent.pid not in children_of(os.getpid())
    finally:
        os.killpg(parent.pid, signal.SIGKILL)  # the sleep is in its group
        parent.wait()


def is_sleep(pid: int) -> bool:
    return command_of(pid) == ["/bin/sleep", "300"]


def test_a_process_that_has_ended_is_no_error() -> None:
    ended = subprocess.Popen(["/bin/true"])
    ended.wait()
    assert not alive(ended.pid)
    assert descendants_of(ended.pid) == command_of(ended.pid) == []
    assert processor_seconds(ended.pid) == 0.0
    with pytest.raises(psutil.NoSuchProcess):
        children_of(ended.pid)
