"""The home page's service, the real application with a pretended worker; looking at its pixels; late answers."""

from __future__ import annotations

import io
import json
import socket
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import trimesh
import uvicorn
from fastapi import FastAPI
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import APIResponse, FloatRect, Page, Route, expect

from regnf_service.server import create_app
from regnf_state.ownership import ANONYMOUS
from regnf_state.settings import Settings
from regnf_state.stores import Stores
from tests.contract.live import eventually
from tests.stores import private_stores
from tests.ui import room
from tests.ui.pretend_worker import PretendWorker

NETWORK = "Failed to load resource"
"""Begins what the browser says of an answer that is no success; the page shows what it makes of it."""
CHAIR = (0.417, 0.484)
"""Where the chair is seen at first, as shares of the view."""
BOX = {"center": [*room.CHAIR_AT, 0.5], "size": [0.8, 0.8, 1.1]}


class StoppingServer(uvicorn.Server):
    """Tells the application first that it stops, as a signal does in a process of its own: threads hear none."""

    def __init__(self, app: FastAPI) -> None:
        super().__init__(uvicorn.Config(app, log_level="error", timeout_graceful_shutdown=1))
        self._app = app

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        self._app.state.services.stopping.set()
        await super().shutdown(sockets)


def true_pose() -> np.ndarray:
    stands = trimesh.transformations.rotation_matrix(room.CHAIR_TURN, (0, 0, 1))
    stands[:3, 3] = (*room.CHAIR_AT, 0.002)
    own = np.diag([1 / room.CHAIR_SCALE] * 3 + [1.0])
    own[:3, 3] = -np.array([3.0, 1.0, 0.0]) / room.CHAIR_SCALE
    return stands @ own


@contextmanager
def served(settings: Settings, stores: Stores) -> Iterator[str]:
    server = StoppingServer(create_app(settings, stores))
    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        try:
            yield f"http://127.0.0.1:{listener.getsockname()[1]}"
        finally:
            server.should_exit = True
            thread.join()


@contextmanager
def home(settings: Settings, caller: str = ANONYMOUS) -> Iterator[str]:
    """The address of the application with a worker that ends everything at once."""
    with (
        private_stores() as stores,
        served(settings, stores) as address,
        PretendWorker(stores.records, stores.blobs, caller, true_pose().tolist()),
    ):
        yield address


def upload(address: str, files: Sequence[Path]) -> list[str]:
    """Send a scene and objects, as the page does; their digests, once each can be shown."""
    found = []
    for file, role in zip(files, ("scene", "object", "object"), strict=False):
        description = json.dumps({"as": role, "label": file.name})
        parts = {"description": (None, description), "file": (file.name, file.read_bytes())}
        found.append(httpx.post(f"{address}/fields", files=parts, timeout=30).json()["sha256"])
    for sha256 in found:
        eventually(lambda at=f"{address}/fields/{sha256}": httpx.get(at).json().get("views") == "ready", "the views")
    return found


def register(address: str, fields: Sequence[str], **more: Any) -> dict[str, Any]:
    """Have the chair registered, or searched for among several objects: the job once it has ended."""
    scene, *objects = fields
    asked = {"object": objects[0]} if len(objects) == 1 else {"candidates": objects}
    answer = httpx.post(f"{address}/register", json={"scene": scene, "detection": BOX, **asked, **more}, timeout=30)
    assert answer.status_code == 202, answer.text

    def ended() -> dict[str, Any] | None:
        job: dict[str, Any] = httpx.get(f"{address}/jobs/{answer.json()['id']}", params={"wait": 5}, timeout=30).json()
        return job if job["status"] == "successful" else None

    return eventually(ended, "the end of a job")


def give_files(page: Page, files: Sequence[Path]) -> None:
    page.set_input_files("#scene-file", files[0])
    page.set_input_files("#object-file", files[1])
    page.wait_for_selector("html[data-scene]")
    expect(page.locator("#objects input:checked")).to_have_count(1)


def choose_scene(page: Page, label: str = "room.ply") -> None:
    page.select_option("#scene-known", label=label)
    page.wait_for_selector("html[data-scene]")


def click_at(page: Page, place: tuple[float, float]) -> None:
    box = box_of(page)
    page.mouse.click(box["x"] + place[0] * box["width"], box["y"] + place[1] * box["height"])


def open_page(page: Page, address: str) -> None:
    page.goto(address)
    page.wait_for_selector("html[data-page=ready]")


# looking at the page's canvas: its pixels as the reader sees them


Pixels = NDArray[np.int16]
Mask = NDArray[np.bool_]


def box_of(page: Page, selector: str = "#canvas") -> FloatRect:
    box = page.locator(selector).bounding_box()
    assert box is not None
    return box


def canvas_pixels(page: Page) -> Pixels:
    """(H, W, 3) of the middle of the canvas, where nothing lies over it, two drawn frames after the last change."""
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    box = box_of(page)
    width, height = box["width"], box["height"]
    clip: FloatRect = {
        "x": box["x"] + width * 0.1, "y": box["y"] + height * 0.2, "width": width * 0.8, "height": height * 0.6,
    }  # fmt: skip
    picture = Image.open(io.BytesIO(page.screenshot(clip=clip)))
    return np.asarray(picture.convert("RGB"), dtype=np.int16)


def changed_share(before: Pixels, after: Pixels) -> float:
    return float(differs(before, after).mean())


def differs(before: Pixels, after: Pixels) -> Mask:
    """(H, W): which pixels differ visibly."""
    marked: Mask = np.abs(before - after).max(axis=-1) > 12
    return marked


def overlap(one: Mask, other: Mask) -> float:
    return float((one & other).sum() / (one | other).sum())


def blue(page: Page) -> Mask:
    """(H, W): which pixels show the object after."""
    pixels = canvas_pixels(page)
    return pixels[..., 2] - pixels[..., 0] > 70


def orange(page: Page) -> Mask:
    """(H, W): which pixels show the object before."""
    pixels = canvas_pixels(page)
    return pixels[..., 0] - pixels[..., 2] > 25


# answers that come late, and in another order than they were asked for


_WAIT_S = 30


class Held:
    """What the service answers at once to requests of a pattern reaches the page only when it is let through."""

    def __init__(self, page: Page, pattern: str) -> None:
        self._page = page
        self._held: list[tuple[Route, APIResponse]] = []
        page.route(pattern, self._hold)
        self.pattern = pattern

    def _hold(self, route: Route) -> None:
        self._held.append((route, route.fetch()))

    def wait(self, count: int = 1) -> None:
        end = time.monotonic() + _WAIT_S
        while len(self._held) < count:
            assert time.monotonic() < end, f"{len(self._held)} of {count} answers to {self.pattern}"
            self._page.wait_for_timeout(20)  # has the browser's messages come in

    def let(self, place: int = 0) -> None:
        route, answer = self._held.pop(place)
        route.fulfill(response=answer)

    def end(self) -> None:
        while self._held:
            self.let()
        self._page.unroute(self.pattern)
