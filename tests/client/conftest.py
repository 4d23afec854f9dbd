"""A service in this process, without waits."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from regnf_client import Client
from regnf_client.client import SyncDriver
from tests.client.transports import Handler, Pretended
from tests.contract.asgi import AppTransport
from tests.contract.conftest import world, worlds
from tests.contract.world import World

__all__ = ["world", "worlds"]


@pytest.fixture
def slept(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The pauses of clients, none of which is waited for."""
    pauses: list[float] = []
    monkeypatch.setattr(SyncDriver, "sleep", lambda _, seconds: pauses.append(seconds))
    return pauses


@pytest.fixture
def transport(world: World) -> Iterator[AppTransport]:
    """To the service of the contract's tests."""
    made = AppTransport(world.app)
    yield made
    made.close()


def pretended(handler: Handler, retries: int = 4) -> Client:
    """A client of a service whose every answer a test writes."""
    return Client("http://service", retries=retries, transport=Pretended(handler))
