"""What the service says about itself, and the page."""

from __future__ import annotations

from typing import Any

import pytest
from redis.exceptions import ConnectionError as RedisConnectionError

from regnf_core import __version__
from tests.contract.world import World, assert_refused


def test_health_and_readiness_and_version(world: World) -> None:
    assert world.client.get("/healthz").json() == {"status": "ok"}
    assert world.client.get("/version").json()["version"] == __version__
    ready = {"status": "ready", "checks": {"records": True, "storage": True, "worker": True}}
    assert world.client.get("/readyz").json() == ready
    assert world.blobs.blobs == {}
    for path in ("/", "/docs", "/healthz", "/readyz", "/version", "/openapi.yaml", "/openapi.json", "/v1/healthz"):
        get, head = world.client.get(path), world.client.head(path)
        assert (head.status_code, head.content) == (200, b""), path
        for name in ("content-type", "content-length"):
            assert head.headers[name] == get.headers[name]


def away() -> bool:
    raise RedisConnectionError("away")


def broken() -> None:
    raise OSError("broken")


@pytest.mark.parametrize(
    ("missing", "reason", "holder", "name", "stand_in"),
    [
        ("records", "STORAGE_UNAVAILABLE", "records", "probe", away),
        ("storage", "STORAGE_UNAVAILABLE", "blobs", "probe", broken),
        ("worker", "NO_WORKER", "queue", "workers", 0),
    ],
)
def test_not_ready_when_something_is_missing(
    world: World, monkeypatch: pytest.MonkeyPatch, missing: str, reason: str, holder: str, name: str, stand_in: Any
) -> None:
    """What takes requests needs no worker."""
    with monkeypatch.context() as patch:
        patch.setattr(getattr(world, holder), name, stand_in)
        problem = assert_refused(world.client.get("/readyz"), 503, "NOT_READY")
        head, without = world.client.head("/readyz"), world.client.get("/readyz", params={"worker": "false"})
    assert problem["detail"] == f"Missing: {missing} ({reason})."
    assert [one for one, there in problem["checks"].items() if not there] == [missing]
    assert problem["reasons"] == {missing: reason}
    assert (head.status_code, head.content, "retry-after" in head.headers) == (503, b"", True)
    assert without.status_code == (200 if missing == "worker" else 503)
    assert without.json()["checks"][missing] is False
    assert_refused(world.client.get("/readyz", params={"worker": "maybe"}), 400, "INVALID_QUERY")


def test_the_index_names_every_address_and_the_contract_is_served_as_json_too(world: World) -> None:
    contract = world.app.openapi()
    named = world.client.get("/").json()["addresses"]
    assert len(named) == sum(len(operations) for operations in contract["paths"].values())
    assert "POST /register" in named
    assert "POST /v1/register" in world.client.get("/v1/").json()["addresses"]
    answer = world.client.get("/openapi.json")
    assert (answer.headers["content-type"], answer.json()) == ("application/json", contract)
    assert answer.json()["x-reasons"]["QUEUE_FULL"]["status"] == 503
