"""Services to break, each over what a test wants to break."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import httpx
import pytest

from regnf_state.redis.client import connect
from tests.faults.house import House, plain_environment
from tests.faults.pace import pace
from tests.faults.proxy import Proxy, to_unix
from tests.faults.stores import Bucket, Folder, Store
from tests.object_store import ObjectServer
from tests.restartable_redis import RestartableRedis, restartable_redis


@contextmanager
def house_over(folder: Path, server: RestartableRedis, store: Store, redis_url: str | None = None) -> Iterator[House]:
    """A house whose processes reach Redis at ``redis_url``, and all end with it."""
    with ExitStack() as stack:
        redis = stack.enter_context(connect(server.url))
        listener = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        address = f"http://127.0.0.1:{listener.getsockname()[1]}"
        client = stack.enter_context(httpx.Client(base_url=address, timeout=60))
        for name in ("tmp", "gates"):
            (folder / name).mkdir()
        environment = plain_environment() | pace().settings | store.environment
        environment |= {"REGNF_REDIS_URL": redis_url or server.url, "TMPDIR": str(folder / "tmp")}
        environment["REGNF_TEST_GATES"] = str(folder / "gates")
        made = House(folder, pace(), server, redis, store, environment, listener, client)
        stack.callback(made.stop)
        yield made


@pytest.fixture
def server() -> Iterator[RestartableRedis]:
    with restartable_redis() as made:
        yield made


@pytest.fixture
def house(tmp_path: Path, objects: ObjectServer, server: RestartableRedis) -> Iterator[House]:
    """API and workers as if on machines of their own, over an object store."""
    with house_over(tmp_path, server, Bucket(objects, objects.new_bucket(), objects.endpoint)) as made:
        yield made
    objects.thaw()


@pytest.fixture
def folder_house(tmp_path: Path, server: RestartableRedis) -> Iterator[House]:
    """API and workers on one machine, over a folder."""
    with house_over(tmp_path, server, Folder(tmp_path / "state")) as made:
        yield made


@pytest.fixture
def network(server: RestartableRedis) -> Iterator[Proxy]:
    with Proxy(to_unix(str(server.folder / "s"))) as made:
        yield made


@pytest.fixture
def far_house(tmp_path: Path, objects: ObjectServer, server: RestartableRedis, network: Proxy) -> Iterator[House]:
    """A house with a network between Redis and everybody else."""
    store = Bucket(objects, objects.new_bucket(), objects.endpoint)
    with house_over(tmp_path, server, store, f"redis://127.0.0.1:{network.port}/0") as made:
        yield made
