"""The supervisor's small parts on their own."""

import errno
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from regnf_cli import embedded_redis
from regnf_cli.embedded_redis import StartError, address_of, check_access, open_socket
from regnf_cli.supervisor import StateLock
from regnf_state.settings import Settings, is_loopback
from tests.processes import alive, command_of, descendants_of
from tests.worker.bench import eventually


def test_what_is_loopback() -> None:
    hosts = ("127.0.0.1", "127.9.9.9", "::1", "localhost", "0.0.0.0", "::", "10.0.0.1", "localhost.example.org", "")
    assert [host for host in hosts if is_loopback(host)] == ["127.0.0.1", "127.9.9.9", "::1", "localhost"]


@pytest.mark.parametrize(
    ("publish", "private"),
    [
        ("127.0.0.1:8080", True), ("127.0.0.1:9000-9010", True), ("[::1]:8080", True), ("0.0.0.0:8080", False),
        ("[::]:8080", False), ("192.0.2.1:8080", False), ("8080", False), ("127.0.0.1:8080:8080", False),
    ],
)  # fmt: skip
def test_a_container_asks_for_no_token_where_only_its_host_reaches_it(publish: str, private: bool) -> None:
    """Whatever the container's own address is."""
    assert Settings(host="127.0.0.1", publish=publish).is_private is private
    settings = Settings(host="0.0.0.0", publish=publish, behind_proxy=True)
    assert settings.is_private is private
    assert settings.calls_per_s == (0 if private else 20)
    if private:
        check_access(settings)
        return
    with pytest.raises(StartError, match=f"^{re.escape(publish)} can be reached from other machines") as caught:
        check_access(settings)
    assert caught.value.reason == "UNAUTHENTICATED_PUBLIC_BIND"
    check_access(settings.model_copy(update={"api_tokens": frozenset({"lab:a-long-random-string"})}))


def test_beyond_loopback_a_proxy_stands_before_it() -> None:
    """And behind one the service is open to others, whatever its own address is."""
    tokens = frozenset({"lab:a-long-random-string"})
    with pytest.raises(StartError, match=r"^0\.0\.0\.0 can be reached from other machines"):
        check_access(Settings(host="0.0.0.0", api_tokens=tokens))
    with pytest.raises(StartError, match=r"^a proxy passes requests on to 127\.0\.0\.1, and no token") as caught:
        check_access(Settings(behind_proxy=True))
    assert caught.value.reason == "UNAUTHENTICATED_PUBLIC_BIND"
    for open_to_all in ({"api_tokens": tokens}, {"allow_unauthenticated": True}):
        check_access(Settings(host="0.0.0.0", behind_proxy=True, **open_to_all))


def test_addresses_to_open() -> None:
    with open_socket(Settings(port=0)) as listener:
        assert address_of(listener) == f"http://127.0.0.1:{listener.getsockname()[1]}"
    with open_socket(Settings(port=0, host="0.0.0.0", allow_unauthenticated=True, behind_proxy=True)) as listener:
        assert address_of(listener).startswith("http://127.0.0.1:")


def test_a_missing_redis_server_is_explained(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(embedded_redis, "_packaged_binary", lambda: None)
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(StartError) as caught:
        embedded_redis.server_binary()
    assert caught.value.reason == "EMBEDDED_REDIS_MISSING"


def test_the_lock_tidies_up_after_a_killed_service(tmp_path: Path) -> None:
    lock = StateLock(tmp_path)
    lock.__enter__()
    left = lock.make_socket_dir()
    lock._file.close()  # what the kernel does when the holder is killed
    with StateLock(tmp_path) as next_one:
        assert not left.exists()
        mine = next_one.make_socket_dir()
        assert mine.is_dir()
    assert not mine.exists()


@pytest.mark.parametrize("content", ["", "{", "[]", '{"socket_dir": "/"}', '{"socket_dir": "/tmp"}'])
def test_the_lock_removes_no_folder_that_is_not_its_own(tmp_path: Path, content: str) -> None:
    (tmp_path / "serve.lock").write_text(content)
    with StateLock(tmp_path):
        assert Path("/tmp").is_dir()


GUARD = """
import os, subprocess, sys, time
subprocess.Popen([sys.executable, "-m", "regnf_cli.guard", str(os.getpid()), "/bin/sleep", "300"])
time.sleep(300)
"""


def test_the_guarded_command_ends_with_whoever_asked_for_it() -> None:
    with subprocess.Popen([sys.executable, "-c", GUARD]) as parent:
        try:

            def sleeper() -> int:
                return next((pid for pid in descendants_of(parent.pid) if "/bin/sleep" in command_of(pid)[:1]), 0)

            command = eventually(sleeper, "the guarded command")
            parent.kill()
            eventually(lambda: not alive(command), "its end")
            assert not alive(command)
        finally:
            parent.kill()


def test_a_guard_that_comes_too_late_runs_nothing() -> None:
    """The parent died between the start and the word to the kernel: the parent process is another one by then."""
    arguments = [sys.executable, "-m", "regnf_cli.guard", "1", "/bin/echo", "ran"]
    done = subprocess.run(arguments, capture_output=True, timeout=60)
    assert (done.returncode, done.stdout) == (-9, b"")


@pytest.mark.parametrize("full", [True, False])
def test_a_folder_that_takes_nothing_is_refused_and_nothing_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, full: bool
) -> None:
    state = tmp_path / "made" / "here"
    if full:
        monkeypatch.setattr(os, "posix_fallocate", _refusing(errno.ENOSPC))
        named, hint = state, "Free space on the disk"
    else:
        (state / "blobs" / ".tmp").mkdir(parents=True)
        named, hint = state / "blobs" / ".tmp", "Give a writable folder"
        usual: Any = tempfile.TemporaryFile
        refuse = _refusing(errno.EROFS)
        monkeypatch.setattr(tempfile, "TemporaryFile", lambda dir: refuse() if dir == named else usual(dir=dir))  # noqa: A006
    with pytest.raises(StartError) as refused, StateLock(state):
        pass
    assert (refused.value.reason, str(named) in str(refused.value)) == ("STATE_DIR_UNUSABLE", True)
    assert hint in (refused.value.hint or "")
    assert list(tmp_path.iterdir()) == ([] if full else [tmp_path / "made"])


def _refusing(number: int) -> Callable[..., Any]:
    def refuse(*_given: Any) -> Any:
        raise OSError(number, os.strerror(number))

    return refuse
