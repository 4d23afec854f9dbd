"""No answer is made whole beyond a bound, none that waits to be read is held beyond one, and no call reads much."""

from __future__ import annotations

import asyncio
import json
import socket
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import ExitStack
from typing import Any

import httpx
import pytest
from starlette.responses import PlainTextResponse

from regnf_core.field_notes import MESH_NAMES, PICTURE_NAME
from regnf_service.concurrency import Slots
from regnf_service.http.middleware import RequestGate
from regnf_state.pieces import view_key
from regnf_state.redis.documents import RedisDocuments
from tests.contract.live import Live, eventually, live_service
from tests.contract.world import World

MIB = 1 << 20
LARGE = bytes(9 * MIB)
LONG = "x" * 2000


# what is handed over at once


def pieces(world: World, path: str, method: str = "GET") -> list[int]:
    """The sizes of the messages in which the application answers, which must be 200."""
    sizes: list[int] = []
    scope = {
        "type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "method": method, "scheme": "http",
        "path": path.partition("?")[0], "raw_path": path.partition("?")[0].encode(), "root_path": "",
        "query_string": path.partition("?")[2].encode(), "headers": [(b"host", b"localhost")],
        "client": ("127.0.0.1", 1), "server": ("127.0.0.1", 80),
    }  # fmt: skip

    async def receive() -> dict[str, Any]:
        await asyncio.Event().wait()
        raise AssertionError

    async def send(message: Any) -> None:
        assert message.get("status", 200) == 200, message
        sizes.append(len(message.get("body", b"")))

    asyncio.run(world.app(scope, receive, send))
    return sizes


def test_files_are_sent_a_block_at_a_time(world: World) -> None:
    sha256 = world.ready_field("large")
    world.client.post("/library", json={"name": "large", "field": sha256})
    for name in (PICTURE_NAME, *MESH_NAMES):
        world.blobs.put(view_key(sha256, name), LARGE)
    world.blobs.put(f"fields/{sha256}/field.safetensors", LARGE)
    job = world.submit()
    world.succeed(job, {"aligned.glb": LARGE})
    shown = [f"/fields/{sha256}/{name}" for name in ("preview.png", "mesh.glb", "mesh.glb?detail=coarse")]
    for path in (*shown, f"/jobs/{job}/artifacts/aligned.glb", "/library/large/file"):
        sizes = pieces(world, path)
        assert (sum(sizes), max(sizes) <= MIB) == (len(LARGE), True), path
        if "library" not in path:
            assert world.client.head(path).headers["content-length"] == str(len(LARGE))
            assert sum(pieces(world, path, "HEAD")) == 0, "nothing is read for a HEAD"


def many_jobs(world: World, count: int) -> list[str]:
    ids = []
    for seed in range(count):
        ids.insert(0, world.submit(seed=seed))
        job = world.run(ids[0])
        world.records.update_job(ids[0], job.attempt, engine={str(place): LONG for place in range(40)})
    return ids


def many_fields(world: World, count: int) -> list[str]:
    names = []
    for number in range(count):
        names.insert(0, world.ready_field(str(number)))
        world.records.update_field(names[0], report={str(place): LONG for place in range(40)})
    return names


@pytest.mark.parametrize(
    ("kind", "name", "filtered", "make"),
    [("jobs", "id", "status=failed", many_jobs), ("fields", "sha256", "label=nope", many_fields)],
)
def test_pages_of_large_records_are_short_and_read_a_few_at_a_time(
    world: World, monkeypatch: pytest.MonkeyPatch, kind: str, name: str, filtered: str, make: Any
) -> None:
    """All 40 of them have 3.2 MB."""
    world.valid_request()
    made, seen, token = make(world, 40), list[str](), ""
    at_once = watched(monkeypatch)
    while token is not None:
        answer = world.client.get(f"/{kind}", params={"limit": 200} | ({"page_token": token} if token else {}))
        assert len(answer.content) <= MIB
        seen += [one[name] for one in answer.json()[kind]]
        token = answer.json()["next_page_token"]
    assert seen[: len(made)] == made, "each exactly once"
    assert len(seen) == len(set(seen))
    assert world.client.get(f"/{kind}?{filtered}").status_code == 200
    assert max(at_once) * 80_000 <= 1.5 * MIB


def watched(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many records each look into Redis has read, from now on."""
    seen: list[int] = []
    fetch = RedisDocuments._fetch_now

    def counted(self: RedisDocuments, kind: Any, names: Any) -> Any:
        seen.append(len(names))
        return fetch(self, kind, names)

    monkeypatch.setattr(RedisDocuments, "_fetch_now", counted)
    return seen


@pytest.mark.parametrize(
    "path", ["/fields?label=nope", "/fields?label=nope&limit=1", "/library?tag=nope", "/library?name=n"]
)
def test_a_filter_looks_at_a_few_hundred_records_a_call(
    world: World, monkeypatch: pytest.MonkeyPatch, path: str
) -> None:
    first = world.ready_field("first")
    for number in range(450):
        world.redis.hset(f"regnf:field:{number:064x}", mapping=stored(world, first, f"{number:064x}"))
        world.redis.zadd("regnf:fields:created:anonymous", {f"{number:064x}": number})
        world.redis.zadd("regnf:owner:anonymous:library", {f"{number:064x}": number})
    read = watched(monkeypatch)
    pages = [world.client.get(path).json()]
    assert sum(read) <= 256
    while (token := pages[-1]["next_page_token"]) is not None:
        pages.append(world.client.get(f"{path}&page_token={token}").json())
    assert 2 <= len(pages) <= 5


def stored(world: World, known: str, name: str) -> dict[str, str]:
    held = {key.decode(): value.decode() for key, value in world.redis.hgetall(f"regnf:field:{known}").items()}
    return held | {"document": held["document"].replace(known, name)}


def test_a_library_that_a_batch_names_in_every_line_is_read_once(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    fields = [world.ready_field(f"of the library {number}") for number in range(12)]
    for number, name in enumerate(fields):
        world.client.post("/library", json={"name": f"n{number}", "field": name, "tags": ["seat"]})
    request = world.valid_request()
    del request["object"]
    lines = [
        json.dumps(request | {"seed": seed, "candidates": {"library": wanted}})
        for seed in range(40)
        for wanted in ({}, {"tags": ["seat"]}, {"names": ["n1", "n2"]})
    ]
    looks: list[Any] = []
    for name in ("list_entries", "entries_named"):
        function = getattr(world.records, name)
        monkeypatch.setattr(world.records, name, lambda *given, call=function: looks.append(given) or call(*given))
    answer = world.client.post("/batches", content="\n".join(lines), headers={"Content-Type": "application/x-ndjson"})
    assert answer.status_code in (200, 202), answer.text
    assert 0 < len(looks) <= 4, "not once a line"


# what waits to be read


async def unread(world_app: Any, caller: str, sizes: list[int]) -> list[int]:
    """The statuses of answers of these sizes to one caller, none of which is read while the others are made."""
    statuses: list[int] = []
    read = asyncio.Event()

    async def send(message: Any) -> None:
        if message["type"] == "http.response.start":
            statuses.append(message["status"])
        elif statuses[-1] == 200:
            await read.wait()

    async with asyncio.TaskGroup() as group:
        for size in sizes:
            scope = {
                "type": "http", "method": "GET", "path": "/openapi.yaml", "size": size, "headers": [],
                "state": {"caller": caller, "request_id": "x"},
            }  # fmt: skip
            group.create_task(world_app(scope, None, send))
            await asyncio.sleep(0.01)
        read.set()
    return statuses


def test_the_bytes_that_nobody_reads_have_a_bound_for_each_caller() -> None:
    async def answer(scope: Any, receive: Any, send: Any) -> None:
        await PlainTextResponse("x" * scope["size"])(scope, receive, send)

    gate = RequestGate(answer, Slots(100, "requests"))

    async def run() -> None:
        assert await unread(gate, "alice", [9 * MIB] * 3) == [200, 200, 429]
        assert await unread(gate, "alice", [100]) == [200], "what was read counts no more"
        assert not gate._unread

    asyncio.run(run())


@pytest.fixture(scope="module")
def unread_service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    with live_service(tmp_path_factory.mktemp("unread"), with_worker=False) as started:
        yield started


def silent(live: Live, path: str) -> socket.socket:
    """A client that asks and never reads. Its buffer is small, so that nearly all is left to the service."""
    connection = socket.socket()
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    connection.connect(("127.0.0.1", live.port))
    connection.sendall(f"GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
    return connection


@pytest.mark.parametrize("path", ["/openapi.yaml", "/static/vendor/three.bundle.min.js", "/openapi.json"])
def test_answers_that_nobody_reads_take_little_memory(unread_service: Live, path: str) -> None:
    """Each time 400 of them, of up to half a megabyte: 100 MB and more if they were held whole."""
    with unread_service.client() as client, ExitStack() as stack:
        size = len(client.get(path).content)
        before = unread_service.peak_memory()
        for _ in range(400):
            stack.enter_context(silent(unread_service, path))
        assert eventually(lambda: client.get("/healthz").status_code == 200, "an answer", 20)
        assert unread_service.peak_memory() - before <= 96 * MIB
    with unread_service.client() as client:
        assert eventually(lambda: len(client.get(path).content) == size, "a whole answer once they are gone", 20)


def test_large_bodies_of_one_caller_are_bounded_by_the_number_of_its_uploads(worlds: Callable[..., World]) -> None:
    """Each would be a mebibyte in memory for as long as its client takes to send it."""
    world = worlds(max_uploads_per_caller=2)
    sending, go_on = asyncio.Event(), asyncio.Event()

    async def large_body() -> AsyncIterator[bytes]:
        yield b" " * 20_000
        sending.set()
        await go_on.wait()
        yield b"{}"

    async def run() -> tuple[int, int, list[int]]:
        transport = httpx.ASGITransport(world.app)
        headers = {"Content-Type": "application/json"}
        async with httpx.AsyncClient(transport=transport, base_url="http://localhost", headers=headers) as client:
            held = [asyncio.create_task(client.post("/register", content=large_body())) for _ in range(2)]
            async with asyncio.timeout(20):
                await sending.wait()
                while (taken := world.app.state.services.uploads.taken) < 2:
                    await asyncio.sleep(0.01)
            small = await client.post("/register", content=b"{}")
            go_on.set()
            return taken, small.status_code, [(await one).status_code for one in held]

    assert asyncio.run(run()) == (2, 422, [422, 422])
    assert world.app.state.services.uploads.taken == 0
