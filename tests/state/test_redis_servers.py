"""The tests run on the server that compose and the chart ship, and on Redis beside it."""

import os
import re
import subprocess
from pathlib import Path

import pytest
import yaml

from regnf_cli.embedded_redis import server_binary
from regnf_state.redis.client import connect
from regnf_state.redis.jobs import RecordStore
from regnf_state.redis.queue import JobQueue
from tests.redis_server import installed_servers
from tests.restartable_redis import restartable_redis
from tests.state.record_makers import job

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def needs_redis() -> None:
    if "redis" not in installed_servers():
        message = "no Redis beside Valkey: `scripts/system-packages.sh test` installs one"
        pytest.fail(message) if os.environ.get("REGNF_REQUIRE_REDIS") else pytest.skip(message)


def test_what_ships_is_what_the_tests_run_on() -> None:
    said = subprocess.run([server_binary(), "--version"], capture_output=True, text=True, check=True).stdout
    version = re.search(r"v=(\d+\.\d+)", said)
    assert version is not None
    shipped = f"valkey/valkey:{version[1]}-trixie"
    assert yaml.safe_load((ROOT / "docker/compose.yaml").read_text())["services"]["redis"]["image"] == shipped
    assert yaml.safe_load((ROOT / "deploy/helm/regnf/values.yaml").read_text())["redis"]["image"] == shipped


@pytest.mark.usefixtures("needs_redis")
def test_valkey_opens_what_redis_has_kept() -> None:
    """Whoever ran the service on Redis can change to what ships now."""
    with restartable_redis(server="redis") as server:
        with connect(server.url) as redis:
            assert "valkey_version" not in redis.info("server")
            store = RecordStore(redis)
            store.create_job(job(store), 10)
            JobQueue(redis).enqueue_registration("j1", 1)
        server.kill()
        server.start("valkey")
        with connect(server.url) as redis:
            assert "valkey_version" in redis.info("server")
            kept = RecordStore(redis).get_job("j1")
            assert kept is not None
            assert kept.status == "accepted"
            assert redis.lrange("rq:queue:regnf", 0, -1) == [b"j1-1"]
