"""What is sent of a field: nothing of one that is held, and of a large one only what has not arrived."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import open3d
import pytest
import trimesh

import regnf
from regnf_client import Client, ServiceError, UnreachableError
from regnf_client.batches import BatchReader
from regnf_client.steps import Deadline
from regnf_core.importing.meshes.ply import read_ply
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


def send(one: Client, thing: Any, *said: Any, **more: Any) -> None:
    """Without waiting for a worker, which this service has not."""
    with pytest.raises(Exception, match="has not ended"):
        one.upload(thing, *said, **more, timeout_s=0.0)


def test_a_large_file_comes_in_pieces(world: World, transport: AppTransport, room: Path) -> None:
    counted = Counted(transport)
    said: list[tuple[str, float]] = []
    send(client(counted), room, progress=lambda phase, share: said.append((phase, share)))
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
    assert [method for method, _ in counted.requests] == ["GET", "PATCH", "GET", "POST"], "the smaller file first"
    with pytest.raises(ServiceError, match=r"room\.safetensors: the service has the same file") as caught:
        client(transport).upload(room, {"level_mask": 3})
    assert caught.value.reason == "FIELD_DESCRIPTION_DIFFERS"
    assert [one.label for one in client(transport).fields()] == ["chair.safetensors", "room.safetensors"]


def test_settings_and_description_go_with_the_pieces(world: World, transport: AppTransport, room: Path) -> None:
    settings = room.with_name("config.yml")
    settings.write_bytes(b"method: neus")
    one = client(transport)
    send(one, room, {"label": "the room"}, settings)
    held = one.field(room)
    assert (held.label, (held.settings or {})["name"], held.bytes) == ("the room", "config.yml", 3000)
    assert not [key for key in world.blobs.blobs if key.startswith("uploads/")]


def test_a_refused_field_is_told_with_its_reason(world: World, transport: AppTransport, room: Path) -> None:
    send(client(transport), room)
    error = {"reason": "FIELD_SHAPES_MISMATCH", "title": "Shapes", "status": 422, "detail": "the shapes do not fit"}
    world.records.update_field(NAME, attempt=1, state="rejected", error=error)
    one = client(transport)
    with pytest.raises(ServiceError, match="the shapes do not fit") as caught:
        one.submit(NAME, NAME, BOX)
    assert caught.value.reason == "FIELD_SHAPES_MISMATCH"


def test_lists_have_every_page(world: World, transport: AppTransport, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("regnf_client.calls._PAGE", 2)
    names = [world.ready_field(f"field {number}") for number in range(5)]
    assert [one.sha256 for one in client(transport).fields()] == names[::-1]
    client(transport).delete_field(names[0])
    assert len(client(transport).fields()) == 4


def things() -> list[tuple[Any, bytes]]:
    """Meshes and clouds in memory, and the family of the file that is made of each."""
    ball = trimesh.creation.icosphere(subdivisions=0)
    points = open3d.utility.Vector3dVector(ball.vertices)
    mesh = open3d.geometry.TriangleMesh(points, open3d.utility.Vector3iVector(ball.faces))
    cloud = open3d.geometry.PointCloud(points)
    cloud.normals = points
    opened = regnf.from_mesh(ball.vertices, ball.faces)
    tensor = open3d.t.geometry.TriangleMesh.from_legacy(mesh)
    return [(one, b"face") for one in (ball, trimesh.Scene(ball), mesh, tensor, opened)] + [(cloud, b"double nx")]


@pytest.mark.parametrize("number", range(6))
def test_what_lies_in_memory_is_sent_as_a_file(world: World, transport: AppTransport, number: int) -> None:
    thing, says = things()[number]
    one = client(transport)
    send(one, thing, {"label": "ball"})
    (field,) = one.fields()
    data = world.blobs.blobs[next(key for key in world.blobs.blobs if field.sha256 in key)]
    assert says in data
    read = read_ply(memoryview(data))
    np.testing.assert_allclose(np.linalg.norm(read.vertices, axis=1), 1.0, atol=1e-6)
    assert len(read.faces) == (0 if says == b"double nx" else 20)
    assert (field.label, field.description.get("as")) == ("ball", None)
    send(one, thing, {"label": "ball"})
    assert len(one.fields()) == 1, "the same mesh is the same file"


def test_scene_and_object_may_lie_in_memory(world: World, transport: AppTransport) -> None:
    balls = [trimesh.creation.icosphere(subdivisions=0, radius=radius) for radius in (1.0, 2.0)]
    one = client(transport)
    for ball, role in zip(balls, ("scene", "object"), strict=True):
        send(one, ball, role=role)
    thing, room = (field.sha256 for field in one.fields())
    for name in (room, thing):
        imported(world, name)
    assert one.submit(*balls, BOX).id == one.submit(room, thing, BOX).id
    reader = BatchReader(one._connection.asking(), [], Deadline(None))
    assert repr(balls[0]) == repr(balls[1])
    sent = [one._driver.run(reader._upload(ball, role)) for ball, role in zip(balls, ("scene", "scene"), strict=True)]
    assert sent == [room, thing], "told apart, although they are shown alike"


@pytest.mark.parametrize("thing", [{"a": 1}, np.zeros((3, 3)), None, 7, trimesh.Trimesh])
def test_what_is_no_mesh_is_refused_before_anything_is_sent(transport: AppTransport, thing: Any) -> None:
    with pytest.raises(regnf.RegnfError, match="expected a field or its path") as caught:
        client(transport).upload(thing)
    assert caught.value.reason == "NO_FIELD"


def test_a_mesh_in_memory_loads_no_torch() -> None:
    program = """
import sys, numpy as np
from types import SimpleNamespace
from regnf_client.fields import source_of
mesh = SimpleNamespace(vertices=np.eye(3), faces=np.array([[0, 1, 2]]))
source = source_of(mesh, role="object")
file = source.file
assert file.read_bytes().startswith(b"ply") and source.description == {"as": "object"}
del source
assert not file.parent.exists() and "torch" not in sys.modules and "scipy" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", program], check=True, timeout=100)
