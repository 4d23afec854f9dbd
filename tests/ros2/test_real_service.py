"""The node with a service of real processes: a statue on a table, seen by a depth camera."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import httpx
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from PIL import Image

from tests.contract.live import Live, eventually
from tests.devdata import ROOT
from tests.live_stack import LIVE, imported
from tests.ros2.conftest import Buffer
from tests.ros2.definitions import boxes, camera_info, image, masks
from tests.ros2.test_images import T_MAP_CAMERA, Robot, moved
from tests.ros2.test_package import matrix

FOLDER = ROOT / "examples" / "data" / "frame"
SIZE = 480, 640
pytestmark = [pytest.mark.usefixtures("ros"), pytest.mark.long, LIVE]


def outline(mask: NDArray[Any]) -> list[tuple[float, float]]:
    """Corners around a mask: down its left edge, up its right edge."""
    rows = np.flatnonzero(mask.any(axis=1))
    ends = [(np.flatnonzero(mask[row])[[0, -1]], row) for row in rows]
    return [(left, row) for (left, _), row in ends] + [(right, row) for (_, right), row in reversed(ends)]


@pytest.fixture
def transport() -> Iterator[httpx.HTTPTransport]:
    with httpx.HTTPTransport() as made:
        yield made


def test_a_statue_is_found_by_its_mask_and_by_its_box(
    monkeypatch: pytest.MonkeyPatch, live_stack: Live, live_client: httpx.Client, transport: httpx.HTTPTransport
) -> None:
    model = imported(live_client, (FOLDER / "cat.stl").read_bytes())["sha256"]
    depth, mask, color = (np.asarray(Image.open(FOLDER / f"{name}.png")) for name in ("depth", "mask", "color"))
    camera = json.loads((FOLDER / "camera.json").read_text())
    vertices = trimesh.load_mesh(FOLDER / "cat.stl").vertices
    truth = T_MAP_CAMERA.matrix().numpy() @ np.array(json.loads((FOLDER / "truth.json").read_text())["T_camera_object"])
    monkeypatch.setattr(Buffer, "known", moved(T_MAP_CAMERA))
    given = {"server": live_stack.address, "objects": f"cat={model}", "object_unit": "auto"}
    robot = Robot(monkeypatch, transport, **given)
    info = camera_info(*reversed(SIZE), tuple(camera[name] for name in ("fx", "fy", "cx", "cy")))
    corners = outline(mask > 0)
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    box = boxes(2.0, ("cat", (*((low + high) / 2.0).tolist(), *(high - low).tolist())))
    meters = depth.astype(np.float32) / 1000.0
    shots = (
        (masks(1.0, SIZE, ("cat", corners)), image(1.0, depth.astype(np.uint16), "16UC1"), None),
        (box, image(2.0, meters, "32FC1", big=True, padding=8), image(2.0, color, "rgb8")),
    )
    for seen, pixels, picture in shots:
        array = robot.see(seen, pixels, picture, info)
        assert len(array.detections) == 1, robot.said
        assert array.header.frame_id == "map"
        scale = float(array.detections[0].id.rpartition("=")[2])
        found = matrix(robot.node.pose_out.sent[-1].pose.pose, scale)
        apart = np.linalg.norm(vertices @ (found - truth)[:3, :3].T + (found - truth)[:3, 3], axis=1)
        assert apart.max() < 0.01
        extent = array.detections[0].bbox.size
        np.testing.assert_allclose([extent.x, extent.y, extent.z], scale * np.ptp(vertices, axis=0), rtol=0.02)
    (left, top), (right, bottom) = low.astype(int), high.astype(int) + 1
    meters[top:bottom, left:right] = np.nan
    box.header.stamp.sec = 3
    assert robot.see(box, image(3.0, meters, "32FC1"), info=info).detections == []
    assert "DETECTION_WITHOUT_DEPTH" in robot.said
    assert live_client.get("/recordings").json()["recordings"] == []
    last = live_client.get("/jobs", params={"status": "successful", "limit": 1}).json()["jobs"][0]["id"]
    address = f"/jobs/{last}/artifacts/overlay.png"
    assert eventually(lambda: live_client.get(address).status_code == 200, "the picture of the result")
