"""The library by the client, over the live application."""

from __future__ import annotations

import asyncio
from pathlib import Path

import httpx
import pytest

from regnf_client import AsyncClient, Client, Entry, ServiceError
from regnf_core.errors import InvalidInputError
from tests.contract.asgi import AppTransport
from tests.contract.world import BOX, World


@pytest.fixture
def client(transport: AppTransport) -> Client:
    return Client("http://localhost", transport=transport)


def test_entries_come_change_and_go(world: World, client: Client, tmp_path: Path) -> None:
    chair = world.ready_field("chair")
    made = client.library.add("office chair", chair, ["seat"], unit="m")
    assert repr(made) == "Entry(office chair, seat, ready)"
    assert client.library.entries() == client.library.entries(tag="seat") == [made]
    assert client.library.entries(tag="table") == client.library.entries(name="table") == []
    changed = client.library.change("office chair", name="stool", unit=None)
    assert (changed.name, changed.unit, changed.tags) == ("stool", None, ["seat"])
    world.blobs.put(f"fields/{chair}/field.safetensors", b"safe")
    assert client.library.download("stool", tmp_path / "stool").read_bytes() == b"safe"
    assert client.library.get("stool") == changed
    client.library.remove("stool")
    library = client.library
    for missing in (library.get, library.remove, lambda name: library.download(name, tmp_path / "x")):
        with pytest.raises(ServiceError) as caught:
            missing("stool")
        assert caught.value.reason == "LIBRARY_ENTRY_NOT_FOUND"


def test_an_entry_stands_for_its_field_and_what_is_wrong_is_said_at_once(world: World, client: Client) -> None:
    entries = [client.library.add(name, world.ready_field(name), ["seat"]) for name in ("chair", "stool")]
    scene = world.ready_field("scene")
    job = client.submit(scene, entries[0], BOX)
    assert client.submit(scene, entries[0].field, BOX).id == job.id
    with pytest.raises(InvalidInputError) as caught:
        client.library.add("a/b", "0" * 64)
    assert caught.value.reason == "LIBRARY_ENTRY_INVALID"
    with pytest.raises(InvalidInputError):
        client.library.get("../fields")


def test_the_awaited_client_has_it_too(world: World) -> None:
    chair = world.ready_field("chair")

    async def use() -> list[Entry]:
        async with AsyncClient("http://localhost", transport=httpx.ASGITransport(world.app)) as client:
            await client.library.add("chair", chair)
            await client.library.change("chair", note="of the hall")
            found = await client.library.entries()
            await client.library.remove("chair")
            return found

    (entry,) = asyncio.run(use())
    assert (entry.name, entry.note) == ("chair", "of the hall")
