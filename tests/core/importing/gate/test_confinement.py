"""What the throw-away process cannot do: each confinement alone and all together, by a child that tries."""

from __future__ import annotations

import json
import os
import resource
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil
import pytest

from regnf_core.importing.gate import gate
from regnf_core.importing.gate.child import MAX_THREADS, run_child
from regnf_core.importing.gate.report import ImportLimits
from tests.processes import alive

ROOT = Path(__file__).resolve().parents[4]
PRELUDE = f"""
import ctypes, errno, json, os, resource, signal, socket, sys, threading
sys.path.insert(0, {str(ROOT)!r})
from regnf_core.importing.gate import sandbox
from regnf_core.importing.gate.report import ImportLimits
from regnf_core.importing.gate.child import MAX_THREADS
request = json.load(sys.stdin)

def attempt(action):
    try:
        return ["done", repr(action())]
    except OSError as error:
        return ["refused", errno.errorcode.get(error.errno)]
"""
CONFINE = """
from pathlib import Path
upload = os.open("upload", os.O_RDONLY | os.O_CREAT)
granted = sandbox.confine(ImportLimits(**request['limits']), request['parent'], [upload], Path.cwd())
"""
NO_NEW_PRIVILEGES = "assert ctypes.CDLL(None).prctl(38, 1, 0, 0, 0) == 0\n"


def tell(folder: Path, program: str, limits: ImportLimits | None = None, **request: Any) -> Any:
    """What a child prints that runs ``program`` in the environment the gate gives."""
    limits = limits or ImportLimits()
    values = {"limits": limits.__dict__, "parent": os.getpid(), **request}
    command = [sys.executable, "-I", "-c", PRELUDE + program]
    outcome = run_child(command, json.dumps(values).encode(), folder, gate._environment(), 60)
    assert outcome.exit_status == 0, outcome
    return json.loads(outcome.stdout)


@pytest.fixture
def listener() -> Iterator[int]:
    """A port of this machine that accepts connections."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server.getsockname()[1]


CONNECT = "attempt(lambda: socket.create_connection(('127.0.0.1', request['port']), 5))"


def test_a_network_namespace_alone_suffices(tmp_path: Path, listener: int) -> None:
    program = f"left = sandbox._leave_network(ctypes.CDLL(None))\nprint(json.dumps([left, {CONNECT}]))"
    assert tell(tmp_path, f"print(json.dumps({CONNECT}))", port=listener)[0] == "done"  # else it would prove nothing
    left, result = tell(tmp_path, program, port=listener)
    if not left:
        pytest.skip("this kernel grants no network namespace")
    assert result[0] == "refused"


FILTER = NO_NEW_PRIVILEGES + "held = sandbox.refuse_system_calls()\n"


def test_no_other_program_takes_its_place(tmp_path: Path) -> None:
    """What else is refused: test_confined_attempts.py."""
    held, result = tell(
        tmp_path, FILTER + "print(json.dumps([held, attempt(lambda: os.execv('/bin/true', ['true']))]))"
    )
    if not held:
        pytest.skip("this kernel has no system call filter")
    assert result in (["refused", "EPERM"], ["refused", "ENOSYS"])


def test_files_still_work_under_the_filter(tmp_path: Path) -> None:
    program = """
with open("note", "w") as file: file.write("x")
os.replace("note", "told")
print(json.dumps([os.path.getsize("told"), os.listdir()]))
"""
    assert tell(tmp_path, FILTER + program) == [1, ["told"]]


def test_threads_work_where_they_are_asked_for(tmp_path: Path) -> None:
    program = """
seen = []
sandbox.refuse_system_calls(threads=True)
worker = threading.Thread(target=seen.append, args=(1,)); worker.start(); worker.join()
print(json.dumps(seen))
"""
    assert tell(tmp_path, NO_NEW_PRIVILEGES + program) == [1]


def test_a_child_with_many_threads_is_ended(tmp_path: Path) -> None:
    """Those that the filter allows are counted from outside."""
    program = (
        CONFINE.replace("Path.cwd())", "Path.cwd(), threads=True)")
        + """
for _ in range(request['threads']): threading.Thread(target=threading.Event().wait, daemon=True).start()
threading.Event().wait()
"""
    )
    values = {"limits": ImportLimits().__dict__, "parent": os.getpid(), "threads": MAX_THREADS + 1}
    command = [sys.executable, "-I", "-c", PRELUDE + program]
    outcome = run_child(command, json.dumps(values).encode(), tmp_path, gate._environment(), 60)
    assert (outcome.stopped, outcome.signal) == ("threads", signal.SIGKILL)


def test_a_child_that_writes_many_files_is_ended(tmp_path: Path) -> None:
    """Each within the limit of one file."""
    program = """
import itertools, os
for number in itertools.count():
    with open(f"file-{number % 32}-{number}", "wb") as file: file.write(bytes(1 << 16))
"""
    outcome = run_child([sys.executable, "-I", "-c", program], b"", tmp_path, {}, 60, folder_bytes=1 << 20)
    assert (outcome.stopped, outcome.signal) == ("output", signal.SIGKILL)


def test_a_process_under_the_filter_may_still_abort(tmp_path: Path) -> None:
    command = [sys.executable, "-I", "-c", PRELUDE + FILTER + "os.abort()"]
    outcome = run_child(command, b"{}", tmp_path, {}, 60)
    assert outcome.signal == signal.SIGABRT


def test_no_secret_is_handed_down_and_the_folder_is_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("REGNF_S3_SECRET", "hunter2")
    monkeypatch.setenv("PYTHONPATH", "/somewhere")
    seen = tell(tmp_path, "print(json.dumps([dict(os.environ), open('/proc/self/environ').read(), os.getcwd()]))")
    assert seen.pop() == str(tmp_path.resolve())
    assert "hunter2" not in json.dumps(seen)
    libraries = {f"{library}_NUM_THREADS" for library in ("OMP", "MKL", "OPENBLAS", "IGL")} | {"PXR_WORK_THREAD_LIMIT"}
    assert set(seen[0]) <= {"PATH", "LANG", "LC_CTYPE"} | libraries


def test_no_open_file_is_handed_down(tmp_path: Path) -> None:
    descriptor = os.open(tmp_path, os.O_RDONLY)
    os.set_inheritable(descriptor, True)
    try:
        assert tell(tmp_path, "print(json.dumps(sorted(map(int, os.listdir('/proc/self/fd')))[:-1]))") == [0, 1, 2]
    finally:
        os.close(descriptor)


def test_resources_are_limited(tmp_path: Path) -> None:
    limits = ImportLimits(wall_s=3.2, memory_bytes=1 << 30, file_bytes=1000)
    limited = ("CPU", "AS", "FSIZE", "CORE", "NOFILE", "NPROC", "MEMLOCK", "MSGQUEUE", "SIGPENDING")
    names = tuple(f"RLIMIT_{name}" for name in limited)
    program = CONFINE + f"print(json.dumps([resource.getrlimit(getattr(resource, n))[0] for n in {names!r}]))"
    assert tell(tmp_path, program, limits) == [7, 1 << 30, 1000, 0, 64, 0, 0, 0, 0]


def test_there_are_no_privileges_and_without_a_limit_on_time_the_processor_has_none(tmp_path: Path) -> None:
    program = CONFINE + "told = dict(line.split(':\\t') for line in open('/proc/self/status'))\n"
    told, most = tell(tmp_path, program + "print(json.dumps([told, resource.getrlimit(resource.RLIMIT_CPU)[0]]))")
    assert most == resource.getrlimit(resource.RLIMIT_CPU)[0]
    status = {name: value.strip() for name, value in told.items()}
    assert status["NoNewPrivs"] == "1"
    assert {int(status[name], 16) for name in ("CapInh", "CapPrm", "CapEff", "CapAmb")} == {0}


def test_a_kernel_without_landlock_is_told(tmp_path: Path) -> None:
    """The filter and the namespace hold; only the report says that files are as readable as the user makes them."""
    program = "from regnf_core.importing.gate import sandbox\nsandbox._CREATE_RULESET = 100_000\n" + CONFINE
    granted = tell(tmp_path, program + "print(json.dumps(granted))")
    assert granted["files_restricted"] is False
    assert granted["no_new_privileges"] is True


@pytest.mark.skipif(os.geteuid() != 0, reason="only root has privileges to give up")
def test_the_upload_may_lie_where_only_privileges_lead(tmp_path: Path) -> None:
    """It was opened before they were given up."""
    closed = tmp_path / "closed"
    closed.mkdir()
    (closed / "upload").write_text("seen")
    os.chown(closed, 65534, 65534)
    closed.chmod(0o700)
    (tmp_path / "upload").symlink_to(closed / "upload")
    program = CONFINE + "print(json.dumps([attempt(lambda: open('upload')), open(f'/proc/self/fd/{upload}').read()]))"
    assert tell(tmp_path, program) == [["refused", "EACCES"], "seen"]


def test_the_child_dies_with_its_parent(tmp_path: Path) -> None:
    """A parent that confines a child and is killed; the child's end closes the pipe that we listen to.

    The child does what it can to live on, and sleeps.
    """
    last = "[ctypes.CDLL(None).prctl(1, 0, 0, 0, 0), ctypes.CDLL(None).setsid(), ctypes.CDLL(None).setpgid(0, 0)]"
    child = PRELUDE + CONFINE + f"{last}\nprint('ready', flush=True)\nthreading.Event().wait()"
    parent = f"""
import json, os, subprocess, sys
values = json.dumps({{"limits": {{}}, "parent": os.getpid()}}).encode()
child = subprocess.Popen([sys.executable, "-I", "-c", {child!r}], stdin=subprocess.PIPE)
child.stdin.write(values); child.stdin.close()
child.wait()
"""
    process = subprocess.Popen([sys.executable, "-c", parent], stdout=subprocess.PIPE, cwd=tmp_path)
    assert process.stdout is not None
    with process.stdout as pipe:
        assert pipe.readline() == b"ready\n"
        process.kill()
        process.wait()
        assert pipe.read() == b""  # blocks for ever if the grandchild lives on: the test's own timeout would tell


def test_the_whole_process_group_is_ended(tmp_path: Path) -> None:
    """A child that leaves a grandchild behind; without the filter it may have one."""
    program = """
import os, sys, time
if os.fork() == 0:
    os.close(1); os.close(2)
    time.sleep(600)
open("grandchild", "w").close()
print(os.getpgrp())
"""
    outcome = run_child([sys.executable, "-I", "-c", program], b"", tmp_path, {}, 60)
    group = int(outcome.stdout)
    deadline = time.monotonic() + 20
    while any_alive(group):
        assert time.monotonic() < deadline, "the grandchild lives on"
        time.sleep(0.01)


def any_alive(group: int) -> bool:
    """Whether a process of the group lives; zombies that nobody has collected yet do not count."""

    def is_member(pid: int) -> bool:
        with suppress(ProcessLookupError):  # it ended meanwhile
            return os.getpgid(pid) == group
        return False

    return any(is_member(pid) and alive(pid) for pid in psutil.pids())
