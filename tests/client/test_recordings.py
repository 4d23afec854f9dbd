"""Recordings by the client, over the live application."""

from __future__ import annotations

import asyncio
import base64
import io
import json
import zipfile
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from PIL import Image

import regnf_client.fields
from regnf_client import AsyncClient, Client, Field, ServiceError
from regnf_core.detections.images import ImageDetection
from regnf_core.errors import FieldFormatError
from tests.contract.asgi import AppTransport
from tests.contract.world import World
from tests.frame_forms import CAMERA, COLOR, DEPTH, SIZE, stored

MASK = np.indices(SIZE)[1] > 5


@pytest.fixture
def client(transport: AppTransport) -> Client:
    return Client("http://localhost", transport=transport)


def ready(world: World, found: Field) -> str:
    world.records.update_field(found.sha256, attempt=1, state="ready", views="none", report={})
    return found.sha256


def files_of(world: World, sha256: str) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(world.blobs.blobs[f"fields/{sha256}/original"])) as read:
        return {name: read.read(name) for name in read.namelist()}


def test_a_folder_is_packed_and_sent_once(world: World, client: Client, tmp_path: Path) -> None:
    folder = tmp_path / "kitchen"
    (folder / "depth").mkdir(parents=True)
    (folder / "depth" / "000.png").write_bytes(DEPTH)
    (folder / "camera.json").write_text(json.dumps(CAMERA))
    found = client.recordings.upload(folder, label="kitchen", wait=False)
    assert (found.state, found.label, found.description) == ("validating", "kitchen", {"as": "recording"})
    assert files_of(world, found.sha256)["depth/000.png"] == DEPTH
    assert client.recordings.upload(folder, wait=False).sha256 == found.sha256
    listed = [*client.recordings.entries(), *client.recordings.entries("kitchen")]
    assert [one.sha256 for one in listed] == [found.sha256] * 2
    ready(world, found)
    assert client.recordings.upload(folder).state == "ready"
    client.recordings.delete(found)
    assert client.recordings.entries() == []
    said = {"depth_unit": 0.0002, "camera_axes": "opengl"}
    described = [client.recordings.upload(folder, wait=False, description=said) for _ in "12"]
    assert [one.description for one in described] == [{"as": "recording", **said}] * 2
    with pytest.raises(FieldFormatError, match="camera_axes"):
        client.recordings.upload(folder, description={"camera_axes": "unity"})


def test_a_large_file_goes_in_pieces(
    world: World, client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("regnf_client.recordings.PIECE_BYTES", 1000)
    monkeypatch.setattr(regnf_client.fields, "PIECE_BYTES", 1000)
    (tmp_path / "bag.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(3000))
    found = client.recordings.upload(tmp_path / "bag.mcap", wait=False)
    assert (found.bytes, found.state) == (3008, "validating")


def test_a_frame_of_arrays_and_its_mask(world: World, client: Client, tmp_path: Path) -> None:
    depth, color = np.full(SIZE, 0.8, np.float32), np.full((*SIZE, 3), 90, np.uint8)
    pose = np.eye(4)
    found = client.recordings.frame(depth, [14.0, 14.0, 8.0, 6.0], color, T_world_camera=pose, wait=False)
    held = files_of(world, found.sha256)
    assert np.array_equal(np.load(io.BytesIO(held["depth.npy"])), depth)
    with Image.open(io.BytesIO(held["color.png"])) as image:
        assert np.array_equal(np.asarray(image), color)
    assert json.loads(held["camera.json"]) == {"K": [14.0, 14.0, 8.0, 6.0], "T_world_camera": pose.tolist()}
    ready(world, found)
    object_ = world.ready_field("object")
    forms: list[Any] = [{"mask": MASK}, [ImageDetection(mask=MASK)], ImageDetection(mask=MASK)]
    jobs = {client.submit(found, object_, one).id for one in forms}
    (job,) = jobs
    (sent,) = world.job(job).request["detection"]
    with Image.open(io.BytesIO(base64.b64decode(sent["mask"]))) as image:
        assert np.array_equal(np.asarray(image) > 0, MASK)
    (tmp_path / "box.json").write_text(json.dumps({"box_2d": [2, 2, 9, 9]}))
    by_file = client.submit(found.sha256, object_, str(tmp_path / "box.json"))
    assert world.job(by_file.id).request["detection"][0]["box_2d"] == [2.0, 2.0, 9.0, 9.0]
    with pytest.raises(ServiceError) as caught:
        client.submit(object_, object_, {"mask": MASK})
    assert caught.value.reason == "IMAGE_DETECTION_WITHOUT_RECORDING"


def test_the_awaited_client_adds_frames_and_shows_them(world: World, tmp_path: Path) -> None:
    (tmp_path / "depth.png").write_bytes(DEPTH)
    (tmp_path / "camera.json").write_text(json.dumps(CAMERA))

    async def use() -> tuple[Field, bytes]:
        async with AsyncClient("http://localhost", transport=httpx.ASGITransport(world.app)) as client:
            one = await client.recordings.frame(
                tmp_path / "depth.png", tmp_path / "camera.json", COLOR, depth_unit=0.002, wait=False
            )
            world.blobs.put(f"fields/{ready(world, one)}/field.safetensors", stored(tmp_path / "field.safetensors"))
            more = await client.recordings.frame(DEPTH, CAMERA, after=one, name="left", wait=False)
            return more, await client.recordings.picture(one, "a")

    more, picture = asyncio.run(use())
    assert more.description["frame"] == "left"
    assert picture.startswith(b"\x89PNG")
    assert json.loads(files_of(world, more.description["after"])["camera.json"])["depth_unit"] == 0.002
