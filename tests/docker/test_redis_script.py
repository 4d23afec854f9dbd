"""The Redis of the compose file: a password of its own, and no command that changes the server."""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from redis import Redis
from redis.exceptions import AuthenticationError, NoPermissionError

from regnf_cli.embedded_redis import answers
from regnf_state.redis.client import connect, redis_address
from regnf_state.redis.jobs import RecordStore
from regnf_state.redis.queue import JobQueue
from regnf_state.settings import Settings
from tests.docker.files import ROOT, services
from tests.redis_server import installed_servers
from tests.state.record_makers import finished, job
from tests.worker.bench import eventually

SCRIPT = ROOT / "docker/redis.sh"


def started(program: str, folder: Path) -> subprocess.Popen[bytes]:
    server = folder / "redis-server"  # a program that is a server or a checker of files goes by its name
    if not server.is_symlink():
        server.symlink_to(program)
    environment = os.environ | {"REDIS_SERVER": str(server), "REDIS_DATA": str(folder), "REDIS_RUN": str(folder)}
    given = services()["redis"]["command"][2:]
    options = [*given, "--port", "0", "--unixsocket", str(folder / "s"), "--loglevel", "warning"]
    process = subprocess.Popen(["sh", str(SCRIPT), *options], env=environment, stdout=subprocess.DEVNULL)
    eventually(lambda: (folder / "password").exists() and answers(address(folder)), "the server", 20)
    return process


def address(folder: Path) -> str:
    return f"unix://:{(folder / 'password').read_text()}@{folder}/s"


@pytest.fixture(scope="module", params=installed_servers())
def folder(request: pytest.FixtureRequest) -> Iterator[Path]:
    """Where the server keeps its data, and its socket."""
    with TemporaryDirectory(prefix="rg-") as made:
        process = started(installed_servers()[request.param], Path(made))
        yield Path(made)
        process.kill()
        process.wait()


def test_without_the_password_nothing_is_done_nor_what_changes_the_server(folder: Path) -> None:
    with Redis.from_url(f"unix://{folder}/s") as redis, pytest.raises(AuthenticationError):
        redis.ping()
    assert re.fullmatch(r"[0-9a-f]{64}", (folder / "password").read_text())
    assert (folder / "users.acl").stat().st_mode & 0o077 == 0
    with connect(address(folder)) as redis:
        refused = ("CONFIG SET dir /tmp", "SAVE", "MODULE LIST", "FLUSHALL", "REPLICAOF a 1", "ACL LIST", "SHUTDOWN")
        for command in refused:
            with pytest.raises(NoPermissionError):
                redis.execute_command(*command.split())  # type: ignore[no-untyped-call]


def test_the_service_works_with_what_is_left(folder: Path) -> None:
    with connect(address(folder)) as redis:
        store = RecordStore(redis)
        finished(store, "successful")
        store.create_job(job(store, "j2"), 10)
        queue = JobQueue(redis)
        queue.enqueue_registration("j2", 1)
        assert queue.holds_registration("j2", 1)
        assert queue.live_workers() == 0
        assert redis.client_list()
        assert redis.info("memory")
        assert redis.memory_usage("regnf:job:j1:events") < 2048, "streams are made compact"  # type: ignore[operator]


def test_the_password_outlives_a_restart(tmp_path: Path) -> None:
    program = next(iter(installed_servers().values()))
    with TemporaryDirectory(prefix="rg-") as made:
        said = set()
        for _ in range(2):
            process = started(program, Path(made))
            said.add((Path(made) / "password").read_text())
            process.kill()
            process.wait()
    assert len(said) == 1


def test_the_address_takes_the_password_of_the_file(tmp_path: Path) -> None:
    file = tmp_path / "password"
    file.write_text("a/b@c\n")
    settings = Settings(redis_url="redis://redis:6379/0", redis_password=f"@{file}")
    assert redis_address(settings) == "redis://:a%2Fb%40c@redis:6379/0"
