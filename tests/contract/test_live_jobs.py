"""From upload to result over the wire: real server, real Redis, real worker, real engine on the demo's fields."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from regnf_core.engine_revision import ENGINE_REVISION
from regnf_service.http.schemas.results import ResultDocument
from tests.contract.live import Live, eventually, live_service
from tests.contract.test_openapi import validator
from tests.contract.world import assert_refused, field_bytes, sha256

DATA = Path(__file__).resolve().parents[2] / "examples" / "data"
QUICK = {
    "preset": "paper",
    "sampling": {"views": 2, "image_size": 64, "pixel_stride": 2},
    "initialization": {"ransac_iterations": 1000},
    "optimization": {"iterations": 5},
}
ENDLESS = {"preset": "paper", "optimization": {"iterations": 10_000, "stop_residual": 0.0}}


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    with live_service(tmp_path_factory.mktemp("live"), heartbeat_s=0.5, workers=1) as started:
        yield started


@pytest.fixture
def client(live: Live) -> Iterator[httpx.Client]:
    with live.client() as made:
        yield made


@pytest.fixture(scope="module")
def fields(live: Live) -> dict[str, str]:
    """The demo's room and armchair, imported."""
    known = {}
    with live.client() as client:
        for role, name in (("scene", "mix-room"), ("object", "armchair")):
            data = (DATA / f"{name}.safetensors").read_bytes()
            assert client.put(f"/fields/{sha256(data)}", content=data).status_code == 201
            known[role] = sha256(data)
        for sha in known.values():
            field = eventually(lambda sha=sha: _imported(client, sha), "an import")  # type: ignore[misc]
            assert field["state"] == "ready", field
    return known


def _imported(client: httpx.Client, sha: str) -> dict[str, Any] | None:
    field: dict[str, Any] = client.get(f"/fields/{sha}", params={"wait": 5}).json()
    return None if field["state"] == "validating" else field


def submit(client: httpx.Client, fields: dict[str, str], **changes: Any) -> httpx.Response:
    detection = json.loads((DATA / "detection.json").read_text())
    return client.post("/register", json={**fields, "detection": detection, "options": QUICK} | changes)


def finished(client: httpx.Client, job_id: str) -> dict[str, Any]:
    def look() -> dict[str, Any] | None:
        job: dict[str, Any] = client.get(f"/jobs/{job_id}", params={"wait": 5}).json()
        return job if job["status"] not in ("accepted", "running") else None

    return eventually(look, "the end of a job", 120)


def test_what_the_import_found_is_part_of_the_field(client: httpx.Client, fields: dict[str, str]) -> None:
    field = client.get(f"/fields/{fields['scene']}").json()
    validator("FieldDocument").validate(field)
    lower, upper = field["report"]["bounds"]
    assert all(low < high for low, high in zip(lower, upper, strict=True))


def test_a_registration_from_request_to_artifacts(client: httpx.Client, fields: dict[str, str]) -> None:
    answer = submit(client, fields)
    assert answer.status_code == 202, answer.text
    job = finished(client, answer.json()["id"])
    assert job["status"] == "successful", job
    validator("JobDocument").validate(job)
    result = client.get(job["links"]["result"])
    validator("ResultDocument").validate(result.json())
    for entry in result.json()["artifacts"]:
        data = client.get(entry["url"]).content
        assert (len(data), sha256(data)) == (entry["bytes"], entry["sha256"])
        assert client.head(entry["url"]).headers["content-length"] == str(len(data))
        assert client.get(entry["url"], headers={"Range": "bytes=0-3"}).content == data[:4]
    assert {"result.json", "trace.json", "aligned.ply"} <= {entry["name"] for entry in result.json()["artifacts"]}
    assert client.get(job["links"]["view"]).status_code == 200
    assert submit(client, fields).status_code == 200
    states = [line for line in client.get(job["links"]["events"]).text.splitlines() if "successful" in line]
    assert len(states) == 1


def test_the_usual_preset_over_the_wire_and_a_second_look_from_its_result(
    client: httpx.Client, fields: dict[str, str]
) -> None:
    first = finished(client, submit(client, fields, options={}).json()["id"])
    assert first["status"] == "successful", first
    result = client.get(first["links"]["result"]).json()
    validator("ResultDocument").validate(result)
    assert set(result) == set(ResultDocument.model_fields)
    assert (result["verdict"], result["options"]["preset"]) == ("registered", "robust")
    assert len(result["covariance"]) == len(result["covariance_ordering"]) == 7
    variance = result["covariance"][6][6]
    assert result["uncertainty"]["scale_percent"] == pytest.approx(100 * variance**0.5)
    start = {"options": {}, "initial_transform": result["T_object_scene"]}
    second = finished(client, submit(client, fields, **start).json()["id"])
    again = client.get(second["links"]["result"]).json()
    assert again["verdict"] == "registered"
    assert again["T_object_scene"]["scale"] == pytest.approx(result["T_object_scene"]["scale"], rel=0.01)


def test_a_search_over_the_wire_finds_the_object_and_keeps_what_it_learned(
    client: httpx.Client, fields: dict[str, str], live: Live
) -> None:
    data = (DATA / "dining-chair.safetensors").read_bytes()
    client.put(f"/fields/{sha256(data)}", content=data)
    names = [fields["object"], sha256(data)]
    body = {"scene": fields["scene"], "detection": json.loads((DATA / "detection.json").read_text())}
    answer = client.post("/register", json=body | {"candidates": names})
    assert answer.status_code == 202, answer.text
    job = finished(client, answer.json()["id"])
    assert job["status"] == "successful", job
    result = client.get(job["links"]["result"]).json()
    validator("ResultDocument").validate(result)
    assert (result["verdict"], result["object"]) == ("registered", fields["object"])
    assert sorted(one["object"] for one in result["candidates"]) == sorted(names)
    first = result["candidates"][0]
    assert (first["stage"], first["T_object_scene"]) == ("refined", result["T_object_scene"])
    for name in names:
        field = client.get(f"/fields/{name}").json()
        validator("FieldDocument").validate(field)
        assert field["symmetry"]["order"] == 1
        assert f"fields/{name}/object-model-{ENGINE_REVISION}.safetensors" in live.files()
    alone = finished(client, submit(client, fields, options={}, seed=5).json()["id"])
    assert client.get(alone["links"]["result"]).json()["object"] == fields["object"]
    assert client.delete(f"/fields/{sha256(data)}").status_code == 204
    assert not any(sha256(data) in path for path in live.files())


def test_a_box_in_empty_space_fails_with_its_own_problem(client: httpx.Client, fields: dict[str, str]) -> None:
    upper = client.get(f"/fields/{fields['scene']}").json()["report"]["bounds"][1]
    corner = {"min": [high - 0.02 for high in upper], "max": [high - 0.01 for high in upper]}
    answer = submit(client, fields, detection=corner)
    assert answer.status_code == 202, answer.text
    job = finished(client, answer.json()["id"])
    assert job["status"] == "failed", job
    problem = assert_refused(client.get(f"/jobs/{job['id']}/result"), 409, "JOB_FAILED")
    assert problem["error"] == job["error"]
    outside = {"min": [high + 1 for high in upper], "max": [high + 2 for high in upper]}
    assert_refused(submit(client, fields, detection=outside), 422, "DETECTION_OUTSIDE_SCENE")


def test_bytes_that_are_no_field_are_rejected_and_their_jobs_fail(
    client: httpx.Client, fields: dict[str, str], live: Live
) -> None:
    data = field_bytes("no field at all")
    with_request = {"request": (None, json.dumps({"detection": {"min": [0, 0, 0], "max": [0.1, 0.1, 0.1]}}))}
    scene = (DATA / "mix-room.safetensors").read_bytes()
    answer = client.post("/register", files=with_request | {"scene": ("s", scene), "object": ("o", data)})
    assert answer.status_code == 202, answer.text
    assert finished(client, answer.json()["id"])["error"]["reason"] == "FIELD_REJECTED"
    field = client.get(f"/fields/{sha256(data)}").json()
    assert field["state"] == "rejected"
    assert field["error"]["reason"]
    assert_refused(submit(client, fields, object=sha256(data)), 422, "FIELD_REJECTED")
    assert not [name for name in live.files() if sha256(data) in name]
    assert client.put(f"/fields/{sha256(data)}", content=data).status_code == 201


def test_a_running_job_is_cancelled_within_seconds(client: httpx.Client, fields: dict[str, str]) -> None:
    job_id = submit(client, fields, options=ENDLESS, seed=3).json()["id"]
    eventually(lambda: client.get(f"/jobs/{job_id}").json()["status"] == "running", "a running job")
    assert client.post(f"/jobs/{job_id}/cancel").status_code == 202
    assert finished(client, job_id)["status"] == "dismissed"
    assert_refused(client.get(f"/jobs/{job_id}/result"), 409, "JOB_DISMISSED")
    assert client.delete(f"/jobs/{job_id}").status_code == 204


def test_the_api_has_not_loaded_torch(live: Live) -> None:
    assert "libtorch" not in Path(f"/proc/{live.api.pid}/maps").read_text()
