"""The rows that matter most, end to end: a real server, a real worker, the gate in its process, the real engine."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import httpx
import pytest

from tests.contract.live import Live, eventually, live_service
from tests.contract.test_live_jobs import DATA, finished
from tests.contract.world import assert_refused, sha256
from tests.core.importing.fuzzing.seeds import Seeds
from tests.gate.bad_containers import CONTAINERS
from tests.gate.bad_pickles import PICKLES
from tests.gate.bad_tensors import TENSORS

FILES = {
    **{row: CONTAINERS[row] for row in ("truncated", "deflate bomb")},
    **{row: PICKLES[row] for row in ("os.system",)},
    **{row: TENSORS[row] for row in ("NaN weights", "a constant field")},
}
QUICK = {
    "preset": "paper",
    "sampling": {"views": 2, "image_size": 64, "pixel_stride": 2},
    "initialization": {"ransac_iterations": 1000},
    "optimization": {"iterations": 5},
}
NOTHING_FOUND = {("failed", "NO_SURFACE_IN_DETECTION"), ("failed", "NO_INITIAL_TRANSFORM")}
"""Honest ends of a registration of what has nothing, or too much, in common, with as little work as these do."""


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    folder = tmp_path_factory.mktemp("live")
    with live_service(folder, heartbeat_s=0.5, workers=1, threads=1) as started:
        yield started
        assert "Traceback" not in started.log()


@pytest.fixture
def client(live: Live) -> Iterator[httpx.Client]:
    with live.client() as made:
        yield made


def imported(client: httpx.Client, data: bytes) -> dict[str, Any]:
    """The field's document once its import has ended."""
    answer = client.put(f"/fields/{sha256(data)}", content=data)
    assert answer.status_code in (200, 201), answer.text

    def look() -> dict[str, Any] | None:
        field: dict[str, Any] = client.get(answer.json()["links"]["self"], params={"wait": 5}).json()
        return None if field["state"] == "validating" else field

    return eventually(look, "the end of an import")


@pytest.mark.parametrize("row", FILES)
def test_a_bad_file_is_rejected_and_leaves_nothing(live: Live, client: httpx.Client, seeds: Seeds, row: str) -> None:
    build, outcome = FILES[row]
    field = imported(client, build(seeds))
    assert f"{field['state']} {field['error']['reason']}" == outcome
    assert not [name for name in live.files() if field["sha256"] in name]
    eventually(lambda: not list((live.folder / "scratch").glob("*/import-*")), "an empty scratch folder")


def test_the_next_good_file_is_taken(client: httpx.Client, seeds: Seeds) -> None:
    """After all of the above, by the same worker; what its process gave up is part of the report."""
    field = imported(client, seeds.field_file)
    assert field["state"] == "ready"
    assert field["report"]["isolation"]["no_new_privileges"]


@pytest.fixture(scope="module")
def pair(live: Live) -> dict[str, str]:
    """The demo's room and armchair."""
    with live.client() as client:
        files = {"scene": "mix-room", "object": "armchair"}
        fields = {role: imported(client, (DATA / f"{name}.safetensors").read_bytes()) for role, name in files.items()}
    assert {field["state"] for field in fields.values()} == {"ready"}
    return {role: field["sha256"] for role, field in fields.items()}


def outcome_of(client: httpx.Client, request: dict[str, Any]) -> tuple[str, str]:
    """How the job ends: status, and its reason or verdict. Any reason but a fault of the service."""
    request = {"detection": json.loads((DATA / "detection.json").read_text()), "options": QUICK} | request
    answer = client.post("/register", json=request)
    assert answer.status_code in (200, 202), answer.text
    job = finished(client, answer.json()["id"])
    result = client.get(f"/jobs/{job['id']}/result")
    if job["status"] == "failed":
        assert assert_refused(result, 409, "JOB_FAILED")["error"] == job["error"]
        return "failed", job["error"]["reason"]
    return job["status"], result.json()["verdict"]


def test_scene_and_object_swapped(client: httpx.Client, pair: dict[str, str]) -> None:
    """Nothing tells that a field was meant as the other one; but the box holds no room, and the job says so."""
    ended = outcome_of(client, {"scene": pair["object"], "object": pair["scene"]})
    assert ended in NOTHING_FOUND or ended[1] != "registered"


def test_the_same_file_twice(client: httpx.Client, pair: dict[str, str]) -> None:
    ended = outcome_of(client, {"scene": pair["scene"], "object": pair["scene"]})
    assert ended in NOTHING_FOUND or ended[0] == "successful"


def test_a_sliver(client: httpx.Client, pair: dict[str, str]) -> None:
    box = json.loads((DATA / "detection.json").read_text()) | {"size": [1e-6, 1e-6, 1e-6]}
    assert outcome_of(client, {**pair, "detection": box}) == ("failed", "NO_SURFACE_IN_DETECTION")


def test_the_whole_scene(client: httpx.Client, pair: dict[str, str]) -> None:
    lower, upper = client.get(f"/fields/{pair['scene']}").json()["report"]["bounds"]
    ended = outcome_of(client, {**pair, "detection": {"min": lower, "max": upper}})
    assert ended in NOTHING_FOUND or ended[0] == "successful"


def test_millimeters_for_meters(client: httpx.Client, pair: dict[str, str]) -> None:
    box = json.loads((DATA / "detection.json").read_text())
    scaled = {name: [1000 * value for value in box[name]] for name in ("center", "size")}
    answer = client.post("/register", json={**pair, "detection": box | scaled})
    assert_refused(answer, 422, "DETECTION_OUTSIDE_SCENE")
