"""What is sent of a field: nothing of one that is held, and of a large one only what has not arrived."""

from __future__ import annotations

import re
from pathlib import Path

import httpx
import pytest

from regnf_client import Client, ServiceError, UnreachableError
from tests.client.transports import Counted
from tests.contract.asgi import AppTransport
from tests.contract.world import BOX, World, field_bytes, sha256

DATA = field_bytes("room", 3000)
NAME = sha256(DATA)


@pytest.fixture
def room(tmp_path: Path) -> Path:
    path = tmp_path / "room.safetensors"
    path.write_bytes(DATA)
    return path


@pytest.fixture(autouse=True)
def small_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("regnf_client.fields.PIECE_BYTES", 1000)


def client(transport: httpx.BaseTransport, retries: int = 4) -> Client:
    return Client("http://localhost", transport=transport, retries=retries)


def imported(world: World, name: str = NAME) -> None:
    """What a worker does."""
    world.records.update_field(name, attempt=1, state="ready", report={"bounds": [[-1, -1, -1], [1, 1, 1]]})


def send(one: Client, path: Path) -> None:
    """Without waiting for a worker, which this service has not."""
    with pytest.raises(Exception, match="has not ended"):
        one.upload(path, timeout_s=0.0)


def test_a_large_file_comes_in_pieces(world: World, transport: AppTransport, room: Path) -> None:
    counted = Counted(transport)
    said: list[tuple[str, float]] = []
    with pytest.raises(Exception, match="has not ended"):
        client(counted).upload(room, progress=lambda phase, share: said.append((phase, share)), timeout_s=0.0)
    puts = [len(body) for (method, _), body in zip(counted.requests, counted.bodies, strict=True) if method == "PUT"]
    assert puts == [0, 1000, 1000, 1000]
    assert world.blobs.blobs == {f"fields/{NAME}/original": DATA}
    assert [share for phase, share in said if phase == "uploading"] == [0.0, 1000 / 3000, 2000 / 3000, 1.0]


def test_a_broken_upload_goes_on_where_it_stopped(world: World, transport: AppTransport, room: Path) -> None:
    def third(request: httpx.Request) -> bool:
        return str(request.headers.get("content-range")) == "bytes 2000-2999/3000"

    with pytest.raises(UnreachableError):
        client(Counted(transport, third), retries=0).upload(room)
    again = Counted(transport)
    send(client(again), room)
    pieces = zip(again.requests, again.bodies, strict=True)
    assert b"".join(body for (method, _), body in pieces if method == "PUT") == DATA[2000:]
    assert world.blobs.blobs == {f"fields/{NAME}/original": DATA}


def test_a_piece_that_breaks_is_sent_again(
    world: World, transport: AppTransport, room: Path, slept: list[float]
) -> None:
    broken: list[str] = []

    def once(request: httpx.Request) -> bool:
        span = request.headers.get("content-range", "")
        if re.match(r"bytes \d", span) and span not in broken:
            broken.append(span)
            return True
        return False

    send(client(Counted(transport, once)), room)
    assert len(slept) == 3
    assert world.blobs.blobs == {f"fields/{NAME}/original": DATA}


class LostAnswers(httpx.BaseTransport):
    """Every second piece arrives, and its answer does not."""

    def __init__(self, inner: httpx.BaseTransport) -> None:
        self._inner = inner
        self._pieces = 0

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        request.read()
        answer = self._inner.handle_request(request)
        self._pieces += "content-range" in request.headers
        if "content-range" in request.headers and self._pieces % 2 == 0:
            raise httpx.ReadError("lost", request=request)
        return answer


def test_answers_that_are_lost_lose_nothing(
    world: World, transport: AppTransport, room: Path, slept: list[float]
) -> None:
    send(client(LostAnswers(transport)), room)
    assert world.blobs.blobs == {f"fields/{NAME}/original": DATA}
    assert slept


def test_nothing_is_sent_of_what_the_service_has(world: World, transport: AppTransport, room: Path) -> None:
    send(client(transport), room)
    imported(world)
    world.ready_field("chair")
    chair = room.with_name("chair.safetensors")
    chair.write_bytes(field_bytes("chair"))
    counted = Counted(transport)
    job = client(counted).submit(room, chair, BOX)
    assert job.status == "accepted"
    assert counted.bytes < 2000
    assert [method for method, _ in counted.requests] == ["GET", "GET", "PATCH", "POST"]
    assert [one.label for one in client(transport).fields()] == ["chair.safetensors", "room.safetensors"]


def test_settings_and_description_go_with_the_pieces(world: World, transport: AppTransport, room: Path) -> None:
    settings = room.with_name("config.yml")
    settings.write_bytes(b"method: neus")
    one = client(transport)
    with pytest.raises(Exception, match="has not ended"):
        one.upload(room, {"label": "the room"}, settings, timeout_s=0.0)
    held = one.field(room)
    assert (held.label, (held.settings or {})["name"], held.bytes) == ("the room", "config.yml", 3000)
    assert not [key for key in world.blobs.blobs if key.startswith("uploads/")]


def test_a_field_held_as_another_function_is_refused(world: World, transport: AppTransport, room: Path) -> None:
    send(client(transport), room)
    imported(world)
    with pytest.raises(ServiceError, match=r"room\.safetensors: the service holds") as caught:
        client(transport).upload(room, {"level_mask": 3})
    assert caught.value.reason == "FIELD_DESCRIPTION_DIFFERS"


def test_a_refused_field_is_told_with_its_reason(world: World, transport: AppTransport, room: Path) -> None:
    send(client(transport), room)
    error = {"reason": "FIELD_SHAPES_MISMATCH", "title": "Shapes", "status": 422, "detail": "the shapes do not fit"}
    world.records.update_field(NAME, attempt=1, state="rejected", error=error)
    one = client(transport)
    with pytest.raises(ServiceError, match="the shapes do not fit") as caught:
        one.submit(NAME, NAME, BOX)
    assert caught.value.reason == "FIELD_SHAPES_MISMATCH"


def test_lists_have_every_page(world: World, transport: AppTransport, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("regnf_client.lists._PAGE", 2)
    names = [world.ready_field(f"field {number}") for number in range(5)]
    assert [one.sha256 for one in client(transport).fields()] == names[::-1]
    client(transport).delete_field(names[0])
    assert len(client(transport).fields()) == 4
