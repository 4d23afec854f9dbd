"""The whole service as a stranger starts it, with the real engine: what goes in, what comes out, what is refused."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from regnf_cli.local_service import running_service
from tests.core.importing.checkpoints import write_small_checkpoint
from tests.devdata import ROOT

DATA = ROOT / "examples" / "data"
ENDLESS = {"preset": "paper", "optimization": {"iterations": 10_000, "stop_residual": 0.0}}
DEADLINE_S = 120
Client = httpx.Client


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    with (
        running_service(tmp_path_factory.mktemp("state"), threads=1) as address,
        httpx.Client(base_url=address, timeout=60) as client,
    ):
        yield client


@pytest.fixture(scope="module")
def demo(client: Client) -> dict[str, Any]:
    """A good request, its fields uploaded."""
    return {
        "scene": upload(client, (DATA / "mix-room.safetensors").read_bytes()),
        "object": upload(client, (DATA / "armchair.safetensors").read_bytes()),
        "detection": json.loads((DATA / "detection.json").read_text()),
    }


def upload(client: Client, content: bytes) -> str:
    sha256 = hashlib.sha256(content).hexdigest()
    response = client.put(f"/fields/{sha256}", content=content)
    assert response.status_code in (200, 201), response.text
    return sha256


def settled_field(client: Client, sha256: str) -> dict[str, Any]:
    return wait(
        lambda: client.get(f"/fields/{sha256}", params={"wait": 20}).json(), lambda f: f["state"] != "validating"
    )


def finished(client: Client, job_id: str) -> dict[str, Any]:
    ends = ("successful", "failed", "dismissed")
    return wait(lambda: client.get(f"/jobs/{job_id}", params={"wait": 20}).json(), lambda job: job["status"] in ends)


def wait(look: Callable[[], dict[str, Any]], done: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    end = time.monotonic() + DEADLINE_S
    while not done(seen := look()):
        assert time.monotonic() < end, seen
    return seen


def submit(client: Client, request: dict[str, Any]) -> str:
    response = client.post("/register", json=request)
    assert response.status_code in (200, 202), response.text
    job_id: str = response.json()["id"]
    return job_id


def test_the_same_request_twice_is_one_job_and_a_rerun_gives_the_identical_result(
    client: Client, demo: dict[str, Any]
) -> None:
    job_id = submit(client, demo)
    assert submit(client, demo) == job_id
    assert finished(client, job_id)["status"] == "successful"
    assert client.post("/register", json=demo).status_code == 200
    first = client.get(f"/jobs/{job_id}/result").json()
    assert client.delete(f"/jobs/{job_id}").status_code == 204
    assert submit(client, demo) == job_id
    finished(client, job_id)
    second = client.get(f"/jobs/{job_id}/result").json()
    assert second["T_object_scene"] == first["T_object_scene"]
    assert second["metrics"]["residual_rms"] == first["metrics"]["residual_rms"]


def test_every_artifact_can_be_fetched_and_is_what_the_manifest_says(client: Client, demo: dict[str, Any]) -> None:
    job_id = submit(client, demo)
    finished(client, job_id)
    result = client.get(f"/jobs/{job_id}/result").json()
    names = {artifact["name"] for artifact in result["artifacts"]}
    assert {"scene_points.ply", "object_points.ply", "aligned.ply", "residuals.npz"} <= names
    assert {"trace.json", "transform.npy", "preview.png"} <= names
    for artifact in result["artifacts"]:
        response = client.get(f"/jobs/{job_id}/artifacts/{artifact['name']}")
        assert response.status_code == 200
        assert len(response.content) == artifact["bytes"]
    part = client.get(f"/jobs/{job_id}/artifacts/preview.png", headers={"Range": "bytes=0-7"})
    assert (part.status_code, part.content) == (206, b"\x89PNG\r\n\x1a\n")


def with_nan(values: dict[str, Any]) -> None:
    values["pipeline"]["_model.field.glin0.bias"][0] = float("nan")


def small_checkpoint(folder: Path, **arguments: Any) -> bytes:
    path = folder / "small.ckpt"
    write_small_checkpoint(path, **arguments)
    return path.read_bytes()


def test_a_wrong_file_is_refused_at_once(client: Client) -> None:
    content = b"\x89PNG\r\n\x1a\n" + bytes(1000)
    response = client.put(f"/fields/{hashlib.sha256(content).hexdigest()}", content=content)
    assert (response.status_code, response.json()["reason"]) == (415, "FIELD_NOT_RECOGNIZED")


def test_a_truncated_checkpoint_and_one_with_nan_are_rejected(client: Client, tmp_path: Path) -> None:
    good = small_checkpoint(tmp_path)
    assert settled_field(client, upload(client, good))["state"] == "ready"
    reasons = []
    for content in (good[: len(good) // 2], small_checkpoint(tmp_path, change=with_nan)):
        field = settled_field(client, upload(client, content))
        assert field["state"] == "rejected"
        reasons.append(field["error"]["reason"])
    assert reasons[1] == "TENSOR_NOT_FINITE"
    assert "TRUNCATED" in reasons[0]


REFUSED: list[tuple[str, dict[str, Any], int, str]] = [
    ("an unknown field", {"scene": "0" * 64}, 404, "FIELD_NOT_FOUND"),
    ("a box outside", {"detection": {"center": [9, 9, 9], "size": [1, 1, 1]}}, 422, "DETECTION_OUTSIDE_SCENE"),
    ("a sliver", {"detection": {"center": [0, 0, 0], "size": [1, 1, 0]}}, 422, "INVALID_DETECTION"),
    ("an unknown option", {"options": {"speed": "fast"}}, 422, "INVALID_OPTIONS"),
    ("no such seed", {"seed": -1}, 422, "INVALID_REQUEST"),
]


@pytest.mark.parametrize(("change", "status", "reason"), [row[1:] for row in REFUSED], ids=[row[0] for row in REFUSED])
def test_bad_requests_are_refused(
    client: Client, demo: dict[str, Any], change: dict[str, Any], status: int, reason: str
) -> None:
    settled_field(client, demo["scene"])
    response = client.post("/register", json={**demo, **change})
    assert (response.status_code, response.json()["reason"]) == (status, reason)


def test_nan_in_a_box_is_refused(client: Client, demo: dict[str, Any]) -> None:
    text = json.dumps({**demo, "detection": {"center": [float("nan"), 0, 0], "size": [1, 1, 1]}})
    response = client.post("/register", content=text, headers={"Content-Type": "application/json"})
    assert response.status_code in (400, 422)
    assert response.json()["reason"] in ("MALFORMED_JSON", "INVALID_DETECTION")


def test_a_box_of_air_holds_no_surface(client: Client, demo: dict[str, Any]) -> None:
    job = finished(client, submit(client, {**demo, "detection": {"center": [0.1, 0.1, 0.5], "size": [0.2, 0.2, 0.2]}}))
    assert (job["status"], job["error"]["reason"]) == ("failed", "NO_SURFACE_IN_DETECTION")


def running(client: Client, request: dict[str, Any]) -> str:
    """A long job that has begun to optimize."""
    job_id = submit(client, {**request, "options": ENDLESS})
    wait(lambda: client.get(f"/jobs/{job_id}", params={"wait": 1}).json(), lambda job: job["phase"] == "optimizing")
    return job_id


def test_a_running_job_can_be_cancelled(client: Client, demo: dict[str, Any]) -> None:
    job_id = running(client, {**demo, "seed": 101})
    assert client.post(f"/jobs/{job_id}/cancel").status_code == 202
    assert finished(client, job_id)["status"] == "dismissed"
    assert client.get(f"/jobs/{job_id}/result").json()["reason"] == "JOB_DISMISSED"


def test_a_job_killed_twice_says_so_and_the_next_one_runs(client: Client, demo: dict[str, Any]) -> None:
    job_id = running(client, {**demo, "seed": 102})
    for attempt in (1, 2):
        wait(
            lambda: client.get(f"/jobs/{job_id}", params={"wait": 1}).json(),
            lambda job, attempt=attempt: (job["attempts"], job["phase"]) == (attempt, "optimizing"),
        )
        (process,) = [pid for pid in processes_with_torch() if is_descendant_of(pid, os.getpid())]
        os.kill(process, signal.SIGKILL)
    job = finished(client, job_id)
    assert (job["status"], job["error"]["reason"]) == ("failed", "WORKER_LOST")
    assert finished(client, submit(client, {**demo, "seed": 103}))["status"] == "successful"


def processes_with_torch() -> list[int]:
    """Processes other than this one that have torch's library mapped: the children that run jobs."""
    found = []
    for maps in Path("/proc").glob("[0-9]*/maps"):
        try:
            if "libtorch" in maps.read_text():
                found.append(int(maps.parent.name))
        except OSError:  # ended meanwhile
            continue
    return [pid for pid in found if pid != os.getpid()]


def is_descendant_of(pid: int, ancestor: int) -> bool:
    while pid > 1:
        try:
            pid = int(Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[1])
        except OSError:
            return False
        if pid == ancestor:
            return True
    return False


def test_the_transform_artifact_is_the_result(client: Client, demo: dict[str, Any], tmp_path: Path) -> None:
    job_id = submit(client, demo)
    finished(client, job_id)
    path = tmp_path / "transform.npy"
    path.write_bytes(client.get(f"/jobs/{job_id}/artifacts/transform.npy").content)
    matrix = client.get(f"/jobs/{job_id}/result").json()["T_object_scene"]["matrix"]
    np.testing.assert_array_equal(np.load(path, allow_pickle=False), np.array(matrix))
