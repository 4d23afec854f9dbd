"""One service of real processes for all tests that need no other: API, Redis, a worker, and the demo's two fields."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import httpx
import pytest

from tests.contract.live import Live, eventually, live_service
from tests.contract.world import sha256
from tests.devdata import ROOT

DATA = ROOT / "examples" / "data"
LIVE = pytest.mark.xdist_group("live")
"""For every file whose tests ask for ``live_stack``: they share a process, so that it is started once."""
QUICK = {
    "preset": "paper",
    "sampling": {"views": 2, "image_size": 64, "pixel_stride": 2},
    "initialization": {"ransac_iterations": 1000},
    "optimization": {"iterations": 5},
}
"""Options of a registration that ends at once."""


@pytest.fixture(scope="session")
def live_stack(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """The service; what a test uploads and asks for stays, so it uses bytes and seeds of its own."""
    settings = {"heartbeat_s": 0.5, "workers": 1, "threads": 1, "preload": True}
    with live_service(tmp_path_factory.mktemp("live"), **settings) as started:
        yield started
        assert "Traceback" not in started.log()


@pytest.fixture
def live_client(live_stack: Live) -> Iterator[httpx.Client]:
    with live_stack.client() as made:
        yield made


@pytest.fixture(scope="session")
def demo_fields(live_stack: Live) -> dict[str, str]:
    """The demo's room and armchair, imported: their names by role."""
    with live_stack.client() as client:
        files = {"scene": "mix-room", "object": "armchair"}
        fields = {role: imported(client, (DATA / f"{name}.safetensors").read_bytes()) for role, name in files.items()}
    assert {field["state"] for field in fields.values()} == {"ready"}, fields
    return {role: field["sha256"] for role, field in fields.items()}


def imported(client: httpx.Client, data: bytes) -> dict[str, Any]:
    """The document of an uploaded field once its import has ended."""
    answer = client.put(f"/fields/{sha256(data)}", content=data)
    assert answer.status_code in (200, 201), answer.text

    def look() -> dict[str, Any] | None:
        field: dict[str, Any] = client.get(answer.json()["links"]["self"], params={"wait": 5}).json()
        return None if field["state"] == "validating" else field

    return eventually(look, "the end of an import")


def demo_request(fields: dict[str, str], **changes: Any) -> dict[str, Any]:
    """A registration of the armchair, as quick as can be; ``changes`` go before that."""
    detection = json.loads((DATA / "detection.json").read_text())
    return {**fields, "detection": detection, "options": QUICK} | changes


def finished(client: httpx.Client, job_id: str) -> dict[str, Any]:
    """The document of a job once it has ended."""

    def look() -> dict[str, Any] | None:
        job: dict[str, Any] = client.get(f"/jobs/{job_id}", params={"wait": 5}).json()
        return job if job["status"] not in ("accepted", "running") else None

    return eventually(look, "the end of a job", 120)
