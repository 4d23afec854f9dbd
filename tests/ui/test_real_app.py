"""The page served by the real application, over the real stores: its policy, its addresses, its documents."""

from __future__ import annotations

import hashlib
import json
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import pytest
from playwright.sync_api import expect

from regnf_service.server import create_app
from regnf_state.blobs.base import BlobStore
from regnf_state.ownership import ANONYMOUS, reference_of
from regnf_state.records import FieldRecord, JobRecord
from regnf_state.redis.jobs import RecordStore
from regnf_state.settings import Settings
from regnf_state.stores import Stores
from tests.stores import private_stores
from tests.ui.conftest import Visit
from tests.ui.home import StoppingServer
from tests.ui.pixels import canvas_pixels, colored
from tests.ui.stories import field_picture
from tests.ui.synthetic import JOB_ID, Synthetic
from tests.ui.synthetic_meshes import object_mesh, scene_mesh

pytestmark = pytest.mark.browser
SCENE, OBJECT = "a3" * 32, "7c" * 32


@dataclass(frozen=True)
class RealService:
    """The application on a port of its own, with one accepted job in its store."""

    origin: str
    records: RecordStore
    blobs: BlobStore

    @property
    def view(self) -> str:
        return f"{self.origin}/jobs/{JOB_ID}/view"

    def finish(self, data: Synthetic) -> None:
        """What a worker does when the registration has ended well."""
        result = {name: value for name, value in data.result.items() if name != "artifacts"}
        files = data.artifacts | {"result.json": json.dumps(result).encode()}
        for name, content in files.items():
            self.blobs.put(f"jobs/{JOB_ID}/1/{name}", content)
        listed = [
            {"name": name, "bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
            for name, content in files.items()
        ]
        self.blobs.put(f"jobs/{JOB_ID}/manifest.json", json.dumps({"attempt": 1, "artifacts": listed}).encode())
        self.records.update_job(JOB_ID, 1, status="successful")


@contextmanager
def real_service(detection: dict[str, object], settings: Settings, owner: str = ANONYMOUS) -> Iterator[RealService]:
    with private_stores() as stores:
        accept(stores, detection, owner)
        server = StoppingServer(create_app(settings, stores))
        with socket.create_server(("127.0.0.1", 0)) as listener:
            thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
            thread.start()
            try:
                yield RealService(f"http://127.0.0.1:{listener.getsockname()[1]}", stores.records, stores.blobs)
            finally:
                server.should_exit = True
                thread.join()


def accept(stores: Stores, detection: dict[str, object], owner: str) -> None:
    """Record a job and its two fields."""
    records, blobs = stores.records, stores.blobs
    now = time.time()
    inputs = {"scene": SCENE, "object": OBJECT, "seed": 7, "detection": detection}
    job = JobRecord(
        JOB_ID,
        "registration",
        "accepted",
        request={"scene": reference_of(owner, SCENE)},
        inputs=inputs,
        created=now,
        updated=now,
    )
    records.create_job(job, max_active=10)
    for sha256 in (SCENE, OBJECT):
        reference = reference_of(owner, sha256)
        records.create_field(FieldRecord(reference, "ready", bytes=1, created=now, updated=now))
        blobs.put(f"fields/{reference}/preview.png", field_picture(sha256))
        blobs.put(f"fields/{reference}/mesh.glb", scene_mesh() if sha256 == SCENE else object_mesh())


def test_follows_a_job_of_the_real_service_to_its_picture(visit: Visit) -> None:
    data = visit.server.stage.data
    with real_service(data.detection, Settings()) as service:
        page = visit.page
        page.goto(service.view)
        expect(page.locator("#message-title")).to_have_text("In the queue")
        service.records.update_job(JOB_ID, 1, status="running")
        service.records.update_job(JOB_ID, 1, phase="optimizing", progress=0.5)
        expect(page.locator("#message-title")).to_have_text("Optimizing", timeout=30_000)
        service.records.update_job(JOB_ID, 1, progress=0.75)
        expect(page.locator("#message-text")).to_have_text("75 % done", timeout=30_000)
        service.finish(data)
        expect(page.locator("#verdict-word")).to_have_text("Registered", timeout=30_000)
        page.wait_for_selector("#tools:not([hidden])")
        assert colored(canvas_pixels(page), "blue").mean() > 0.01
        page.locator("#color").select_option("residual")
        page.wait_for_selector("#legend svg rect")
        expect(page.locator("#box-chip")).to_be_visible()
        expect(page.locator("#files")).to_contain_text("result.json")
        expect(page.locator("#field-pictures canvas")).to_have_count(2)
        assert visit.complaints == []
        assert [url for url in visit.requests if not url.startswith(service.origin + "/")] == []
        page.goto("about:blank")  # lets go of the connections before the server ends


def test_failed_job_of_the_real_service(visit: Visit) -> None:
    with real_service(visit.server.stage.data.detection, Settings()) as service:
        error = {"reason": "NO_SURFACE_IN_DETECTION", "detail": "12 points were found; 500 are needed."}
        service.records.update_job(JOB_ID, 1, status="failed", error=error)
        visit.page.goto(service.view.replace("/jobs/", "/v1/jobs/"))
        expect(visit.page.locator("#message-text")).to_have_text("12 points were found; 500 are needed.")
        expect(visit.page.locator("#message-title")).to_have_text("No surface in the detection")
        visit.page.goto("about:blank")


def test_page_of_a_guarded_service_asks_for_the_token(visit: Visit) -> None:
    settings = Settings(api_tokens=frozenset({"robot:open-sesame"}))
    with real_service(visit.server.stage.data.detection, settings, owner="robot") as service:
        service.records.update_job(JOB_ID, 1, status="running")
        service.finish(visit.server.stage.data)
        page = visit.page
        page.goto(service.view)
        page.locator("#token").fill("open-sesame")
        page.keyboard.press("Enter")
        page.wait_for_selector("#tools:not([hidden])")
        expect(page.locator("#verdict-word")).to_have_text("Registered")
        page.goto("about:blank")
