"""A caller's calls that take long keep that caller's further calls waiting, and nobody else's."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from functools import wraps
from typing import Any

import httpx
import pytest

from regnf_service.fields.uploads import Upload
from regnf_service.http import body
from regnf_state.ownership import reference_of
from tests.contract.world import ALICE, BOB, TOKENS, World, field_bytes, sha256

MANY = 60
"""More than there are threads for stores."""
PATIENCE_S = 20.0


class Held:
    """Calls that do not return until the test is over; those that are ``meant`` of the functions that it wraps."""

    def __init__(self) -> None:
        self.over = threading.Event()
        self.count = 0

    def hold(self, monkeypatch: pytest.MonkeyPatch, owner: Any, name: str, meant: Callable[..., bool]) -> None:
        function = getattr(owner, name)

        @wraps(function)
        def wrapped(*arguments: Any, **named: Any) -> Any:
            if meant(*arguments, **named):
                self.count += 1
                self.over.wait(60)
            return function(*arguments, **named)

        monkeypatch.setattr(owner, name, wrapped)


@pytest.fixture
def shared(worlds: Callable[..., World]) -> World:
    return worlds(api_tokens=TOKENS)


@asynccontextmanager
async def busy(held: Held, app: Any, ask: Callable[[httpx.AsyncClient], Awaitable[Any]]) -> AsyncIterator[Any]:
    """Alice asks so many times at once; then the context gets a client of Bob's."""
    transport = httpx.ASGITransport(app)
    async with (
        httpx.AsyncClient(transport=transport, base_url="http://localhost", headers=ALICE, timeout=90) as alice,
        httpx.AsyncClient(transport=transport, base_url="http://localhost", headers=BOB, timeout=90) as bob,
    ):
        asked = [asyncio.create_task(_asked(ask, alice)) for _ in range(MANY)]
        try:
            async with asyncio.timeout(PATIENCE_S):
                while not held.count or app.state.services.requests.taken < MANY:
                    await asyncio.sleep(0.01)
            yield bob
        finally:
            held.over.set()
            await asyncio.gather(*asked)


async def _asked(ask: Callable[[httpx.AsyncClient], Awaitable[Any]], client: httpx.AsyncClient) -> None:
    await ask(client)


async def answered(answer: Awaitable[httpx.Response]) -> int:
    async with asyncio.timeout(PATIENCE_S):
        return (await answer).status_code


@pytest.mark.parametrize(
    ("path", "function"),
    [
        ("/fields?label=nope", "list_fields"),
        ("/jobs?status=failed", "list_jobs"),
        ("/library?tag=none", "list_entries"),
        (f"/fields/{'0' * 64}", "get_field"),
    ],
)
def test_reads_of_one_caller_hold_nobody_elses(
    shared: World, monkeypatch: pytest.MonkeyPatch, path: str, function: str
) -> None:
    held = Held()

    async def both() -> list[int]:
        held.hold(monkeypatch, shared.records, function, lambda *given, **_: "alice" in str(given))
        async with busy(held, shared.app, lambda alice: alice.get(path)) as bob:
            return [await answered(bob.get(one)) for one in (path, "/fields", "/jobs", "/healthz", "/readyz")]

    statuses = asyncio.run(both())
    assert statuses[1:4] == [200] * 3
    assert statuses[0] in (200, 404)
    assert statuses[4] in (200, 503), "no worker runs here"


def test_whoever_asks_whether_the_service_is_ready_does_not_wait_behind_its_own_reads(
    shared: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    held = Held()

    async def both() -> int:
        held.hold(monkeypatch, shared.records, "list_jobs", lambda *_: True)
        async with busy(held, shared.app, lambda alice: alice.get("/jobs")) as bob:
            return await answered(bob.get("/readyz", headers=ALICE))

    assert asyncio.run(both()) in (200, 503)


def test_bodies_of_one_caller_are_read_beside_those_of_others(shared: World, monkeypatch: pytest.MonkeyPatch) -> None:
    held = Held()
    large = [sha256(str(number).encode()) for number in range(400)]

    def request(label: str) -> bytes:
        return json.dumps({"scene": "0" * 64, "candidates": large, "label": label}).encode()

    async def both() -> int:
        held.hold(monkeypatch, body, "read_model", lambda _model, text, *_: b"greedy" in text)
        headers = {"Content-Type": "application/json"}

        async def ask(client: httpx.AsyncClient, label: str) -> httpx.Response:
            return await client.post("/register", content=request(label), headers=headers)

        async with busy(held, shared.app, lambda alice: ask(alice, "greedy")) as bob:
            return await answered(ask(bob, "honest"))

    assert asyncio.run(both()) in (404, 422)


@pytest.mark.parametrize("method", ["put", "form"])
def test_uploads_of_one_caller_are_written_beside_those_of_others(
    shared: World, monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    held = Held()

    async def send(client: httpx.AsyncClient, name: str) -> httpx.Response:
        data = field_bytes(name)
        if method == "form":
            return await client.post("/fields", files={"file": ("field", data)})
        return await client.put(f"/fields/{sha256(data)}", content=data)

    async def both() -> int:
        held.hold(monkeypatch, Upload, "_take", lambda _self, block: b"greedy" in block)
        async with busy(held, shared.app, lambda alice: send(alice, "greedy")) as bob:
            return await answered(send(bob, "honest"))

    assert asyncio.run(both()) == 201


def test_looks_for_one_callers_held_answers_hold_nobody_elses(shared: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second look of each: the first is a read like any other."""
    held = Held()
    data = field_bytes("waited for")
    path = f"/fields/{sha256(data)}"
    for caller in (ALICE, BOB):
        assert shared.client.put(path, content=data, headers=caller).status_code == 201
    looked: dict[int, int] = {}

    def again(reference: str) -> bool:
        task = threading.get_ident()
        looked[task] = looked.get(task, 0) + ("alice" in reference)
        return "alice" in reference and sum(looked.values()) > MANY

    async def both() -> int:
        held.hold(monkeypatch, shared.records, "get_field", again)
        async with busy(held, shared.app, lambda alice: alice.get(path, params={"wait": 30})) as bob:
            status = await answered(bob.get(path, params={"wait": 1}))
            shared.records.update_field(reference_of("alice", sha256(data)), attempt=1, state="ready")  # no more waits
            return status

    assert asyncio.run(both()) == 200
