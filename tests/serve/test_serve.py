"""`regnf serve` with real processes: it comes up unconfigured, and leaves nothing running however it ends."""

import os
import signal
import socket
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

import httpx
import pytest

from tests.processes import alive, command_of
from tests.redis_server import private_redis
from tests.serve.service import DEADLINE_S, Service, command, environment, start
from tests.worker.bench import eventually


@contextmanager
def started(state_dir: Path, *arguments: str, **settings: object) -> Iterator[Service]:
    """A service that has ended with all its processes once the context is left. A worker that loads the engine takes
    most of the start: none does, tests/serve/test_secrets.py aside."""
    service = start(state_dir, *arguments, preload="false", **settings)
    try:
        yield service
    finally:
        service.end()
        eventually(service.all_gone, "the end of every process", DEADLINE_S)


NO_WORKER = ("--workers", "0")


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """One for the tests that leave it as they found it."""
    with started(tmp_path_factory.mktemp("shared") / "state") as service:
        yield service


def test_it_comes_up_with_nothing_configured(shared: Service) -> None:
    shared.await_ready()
    assert httpx.get(f"{shared.address}/healthz").json() == {"status": "ok"}
    parts = ("unixsocket:", "regnf_worker.main", "regnf_cli.api_process")
    assert {shared.part(part) for part in parts} == shared.look(), [command_of(pid) for pid in shared.look()]
    assert shared.address.startswith("http://127.0.0.1:")
    assert oct(shared.socket_dir().stat().st_mode & 0o777) == "0o700"
    assert oct(shared.state_dir.stat().st_mode & 0o777) == "0o700"
    redis = shared.part("unixsocket:")
    assert not listening_sockets(redis), "Redis has no TCP port"
    assert listening_sockets(shared.part("regnf_cli.api_process")), "or this test cannot tell"


def listening_sockets(pid: int) -> set[str]:
    """Inodes of the TCP sockets on which a process listens."""
    inodes = set()
    for entry in Path(f"/proc/{pid}/fd").iterdir():
        with suppress(FileNotFoundError):  # closed meanwhile
            inodes.add(os.readlink(entry))
    tables = (line.split() for name in ("tcp", "tcp6") for line in Path(f"/proc/net/{name}").read_text().splitlines())
    return {entry[9] for entry in tables if entry[3] == "0A" and f"socket:[{entry[9]}]" in inodes}


def ends_in_order(service: Service, number: signal.Signals = signal.SIGTERM) -> None:
    folder = service.socket_dir()
    service.look()
    service.process.send_signal(number)
    assert service.process.wait(DEADLINE_S) == 0
    assert service.all_gone(), "nothing outlives the one who waited for it"
    assert not folder.exists()
    assert [word for word in ("Traceback", "ERROR", "exceeded", "killed") if word in service.log()] == []


def test_a_signal_ends_everything_in_order(tmp_path: Path) -> None:
    with started(tmp_path / "state") as service:
        service.await_ready()
        ends_in_order(service)
        assert service.process.returncode == 0


def test_ctrl_c_reaches_the_supervisor_alone(shared: Service) -> None:
    """A terminal sends SIGINT to its whole foreground group: Redis must not go before the jobs are given back."""
    group = os.getpgid(shared.process.pid)
    assert len(shared.look()) == 3
    assert all(os.getpgid(pid) != group for pid in shared.look())


def test_a_killed_supervisor_takes_everything_along(tmp_path: Path) -> None:
    with started(tmp_path / "state") as service:
        service.await_ready()
        folder = service.socket_dir()
        service.process.kill()
        service.process.wait()
        eventually(service.all_gone, "the end of every process", DEADLINE_S)
        assert folder.exists(), "nobody was left to remove it"
        with started(service.state_dir, *NO_WORKER) as following:
            assert not folder.exists(), "the next one does"
            ends_in_order(following, signal.SIGHUP)


def test_a_supervisor_killed_while_it_starts_leaves_nothing(tmp_path: Path) -> None:
    process = subprocess.Popen(command(tmp_path / "state"), env=environment(preload="false"), stderr=subprocess.DEVNULL)
    started = Service(process, tmp_path / "state", "")
    eventually(started.look, "a first child", DEADLINE_S)
    process.kill()
    process.wait()
    eventually(started.all_gone, "the end of every process", DEADLINE_S)
    assert [pid for pid in started.seen if alive(pid)] == []
    started.end()


@pytest.mark.parametrize("part", ["regnf_worker.main", "regnf_cli.api_process", "unixsocket:"])
def test_a_part_that_dies_is_started_anew(shared: Service, part: str) -> None:
    shared.await_ready()
    before = shared.part(part)
    os.kill(before, signal.SIGKILL)
    eventually(lambda: not alive(before), "its end")
    eventually(lambda: shared.part(part) != before, "its successor", DEADLINE_S)
    shared.await_ready()
    assert shared.process.poll() is None


def upload(address: str, content: bytes) -> str:
    answer = httpx.post(f"{address}/fields", content=b"PK\x03\x04" + content)
    assert answer.status_code == 201, answer.text
    return str(answer.json()["sha256"])


def test_whoever_waits_is_answered_before_the_end_and_the_next_service_has_their_fields(tmp_path: Path) -> None:
    """Without a worker there is no news: the stop alone ends what is waited for, in order."""
    with started(tmp_path / "state", *NO_WORKER) as service:
        scene, object_ = (upload(service.address, name) for name in (b"scene", b"object"))
        asked = {"scene": scene, "object": object_, "detection": {"min": [0, 0, 0], "max": [1, 1, 1]}}
        job = httpx.post(f"{service.address}/register", json=asked).json()["id"]
        with ExitStack() as held:
            waiting = [
                held.enter_context(sent(service.address, f"GET {path}?wait=30"))
                for path in (f"/jobs/{job}", f"/fields/{scene}", f"/fields/{object_}")
            ]
            stream = held.enter_context(sent(service.address, f"GET /jobs/{job}/events"))
            told = stream.readline()
            service.process.terminate()
            assert [one.readline() for one in waiting] == [b"HTTP/1.1 200 OK\r\n"] * 3
            assert (told + stream.read()).endswith(b"0\r\n\r\n"), "the stream ends whole"
        assert service.process.wait(DEADLINE_S) == 0
        log = service.log()
        assert [word for word in ("Traceback", "ERROR", "exceeded", "killed") if word in log] == [], log
    with started(tmp_path / "state", *NO_WORKER) as following:
        assert httpx.get(f"{following.address}/fields/{scene}").json()["state"] == "validating"
        ends_in_order(following, signal.SIGINT)


@contextmanager
def sent(address: str, asked: str) -> Iterator[BinaryIO]:
    """What a connection of its own is answered; the request lies in the server's buffers already."""
    host, _, port = address.removeprefix("http://").partition(":")
    with socket.create_connection((host, int(port)), DEADLINE_S) as connection:
        connection.sendall(f"{asked} HTTP/1.1\r\nHost: {host}:{port}\r\nConnection: close\r\n\r\n".encode())
        with connection.makefile("rb") as answer:
            yield answer


def test_one_service_to_a_state_folder(shared: Service) -> None:
    shared.await_ready()
    another = command(shared.state_dir)
    done = subprocess.run(another, env=environment(), capture_output=True, text=True, timeout=DEADLINE_S)
    assert (done.returncode, done.stdout, "STATE_DIR_IN_USE" in done.stderr) == (3, "", True), done.stderr
    assert "Traceback" not in done.stderr
    assert shared.is_ready()


def test_without_an_embedded_redis_there_is_one_child_less(tmp_path: Path) -> None:
    with private_redis() as url, started(tmp_path / "state", *NO_WORKER, redis_url=url) as service:
        assert [command_of(pid) for pid in service.look() if "regnf_cli.api_process" not in command_of(pid)] == []
        assert len(service.look()) == 1
