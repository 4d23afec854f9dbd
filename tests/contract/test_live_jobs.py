"""From upload to result over the wire: real server, real Redis, real worker, real engine on the demo's fields."""

from __future__ import annotations

import io
import json
from io import BytesIO
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import torch
from PIL import Image

from regnf_core.document import ResultDocument
from regnf_core.fields.build import open_field
from regnf_core.version import ENGINE_REVISION
from tests.contract.live import Live, eventually
from tests.contract.test_openapi import validator
from tests.contract.world import assert_refused, field_bytes, put, sha256
from tests.live_stack import DATA, LIVE, demo_request, finished

pytestmark = LIVE
ENDLESS = {"preset": "paper", "optimization": {"iterations": 10_000, "stop_residual": 0.0}}

OWN_SEED = 61
"""Of a request that no other test of the same service makes."""


def submit(client: httpx.Client, fields: dict[str, str], **changes: Any) -> httpx.Response:
    return client.post("/register", json=demo_request(fields, **changes))


def arrived(client: httpx.Client, url: str) -> httpx.Response:
    """An artifact, asked for again while it is not made: on a busy machine that takes longer than an answer is held."""

    def answer() -> httpx.Response | None:
        found = client.get(url)
        return None if found.status_code == 409 else found

    return eventually(answer, url, 120.0)


def test_a_registration_from_request_to_artifacts(live_client: httpx.Client, demo_fields: dict[str, str]) -> None:
    field = live_client.get(f"/fields/{demo_fields['scene']}").json()
    validator("FieldDocument").validate(field)
    assert all(low < high for low, high in zip(*field["report"]["bounds"], strict=True))
    answer = submit(live_client, demo_fields, seed=OWN_SEED)
    assert answer.status_code == 202, answer.text
    job = finished(live_client, answer.json()["id"])
    assert job["status"] == "successful", job
    validator("JobDocument").validate(job)
    first = live_client.get(job["links"]["result"]).json()
    validator("ResultDocument").validate(first)
    for entry in first["artifacts"]:  # the answer waits for those that are still to be made
        assert arrived(live_client, entry["url"]).status_code == 200
    result = live_client.get(job["links"]["result"]).json()
    for entry in result["artifacts"]:
        data = live_client.get(entry["url"]).content
        assert (len(data), sha256(data)) == (entry["bytes"], entry["sha256"])
    assert {"result.json", "trace.json", "aligned.ply"} <= {entry["name"] for entry in result["artifacts"]}
    assert submit(live_client, demo_fields, seed=OWN_SEED).status_code == 200
    assert live_client.get(job["links"]["events"]).text.count('"successful"') == 1
    assert live_client.delete(f"/jobs/{job['id']}").status_code == 204
    assert submit(live_client, demo_fields, seed=OWN_SEED).json()["id"] == job["id"], "one request is one job"
    finished(live_client, job["id"])
    again = live_client.get(job["links"]["result"]).json()
    assert again["T_object_scene"] == result["T_object_scene"]
    assert again["metrics"]["residual_rms"] == result["metrics"]["residual_rms"]


def test_the_usual_preset_over_the_wire_and_a_second_look_from_its_result(
    live_client: httpx.Client, demo_fields: dict[str, str]
) -> None:
    def registered(**changes: Any) -> dict[str, Any]:
        job = finished(live_client, submit(live_client, demo_fields, options={}, **changes).json()["id"])
        assert job["status"] == "successful", job
        result: dict[str, Any] = live_client.get(job["links"]["result"]).json()
        assert (result["verdict"], result["object"]) == ("registered", demo_fields["object"])
        return result

    result = registered()
    validator("ResultDocument").validate(result)
    assert set(result) == set(ResultDocument.model_fields) - {"missing_artifacts"}
    assert result["options"]["preset"] == "robust"
    assert len(result["covariance"]) == len(result["covariance_ordering"]) == 7
    assert result["uncertainty"]["scale_percent"] == pytest.approx(100 * result["covariance"][6][6] ** 0.5)
    files = {entry["name"]: entry["url"] for entry in result["artifacts"]}
    assert {"scene_points.ply", "object_points.ply", "residuals.npz", "trace.json"} <= set(files)
    assert arrived(live_client, files["preview.png"]).content.startswith(b"\x89PNG\r\n\x1a\n")
    matrix = np.load(BytesIO(live_client.get(files["T_scene_object.npy"]).content), allow_pickle=False)
    np.testing.assert_array_equal(matrix, result["T_scene_object"]["matrix"])
    again = registered(initial_transform=result["T_object_scene"])
    assert again["T_object_scene"]["scale"] == pytest.approx(result["T_object_scene"]["scale"], rel=0.01)


def test_a_search_over_the_wire_finds_the_object_and_keeps_what_it_learned(
    live_client: httpx.Client, demo_fields: dict[str, str], live_stack: Live
) -> None:
    other = put(live_client, (DATA / "dining-chair.safetensors").read_bytes()).json()["sha256"]
    names = [demo_fields["object"], other]
    body = {"scene": demo_fields["scene"], "detection": json.loads((DATA / "detection.json").read_text())}
    answer = live_client.post("/register", json=body | {"candidates": names})
    assert answer.status_code == 202, answer.text
    job = finished(live_client, answer.json()["id"])
    assert job["status"] == "successful", job
    result = live_client.get(job["links"]["result"]).json()
    validator("ResultDocument").validate(result)
    assert (result["verdict"], result["object"]) == ("registered", demo_fields["object"])
    assert sorted(one["object"] for one in result["candidates"]) == sorted(names)
    first = result["candidates"][0]
    assert first["stage"] == "refined"
    assert all(first[told] == result[told] for told in ("T_scene_object", "T_object_scene", "probability", "level"))
    for name in names:
        field = live_client.get(f"/fields/{name}").json()
        validator("FieldDocument").validate(field)
        assert field["symmetry"]["order"] == 1
        assert f"fields/{name}/object-model-{ENGINE_REVISION}.safetensors" in live_stack.files()
    assert live_client.delete(f"/fields/{other}").status_code == 204
    assert not any(other in path for path in live_stack.files())


def test_a_box_in_empty_space_fails_with_its_own_problem(
    live_client: httpx.Client, demo_fields: dict[str, str]
) -> None:
    upper = live_client.get(f"/fields/{demo_fields['scene']}").json()["report"]["bounds"][1]
    corner = {"min": [high - 0.02 for high in upper], "max": [high - 0.01 for high in upper]}
    answer = submit(live_client, demo_fields, detection=corner)
    assert answer.status_code == 202, answer.text
    job = finished(live_client, answer.json()["id"])
    assert job["status"] == "failed", job
    problem = assert_refused(live_client.get(f"/jobs/{job['id']}/result"), 409, "JOB_FAILED")
    assert problem["error"] == job["error"]
    outside = {"min": [high + 1 for high in upper], "max": [high + 2 for high in upper]}
    assert_refused(submit(live_client, demo_fields, detection=outside), 422, "DETECTION_OUTSIDE_SCENE")


def test_bytes_that_are_no_field_are_rejected_and_their_jobs_fail(
    live_client: httpx.Client, demo_fields: dict[str, str], live_stack: Live
) -> None:
    data = field_bytes("no field at all")
    with_request = {"request": (None, json.dumps({"detection": {"min": [0, 0, 0], "max": [0.1, 0.1, 0.1]}}))}
    scene = (DATA / "mix-room.safetensors").read_bytes()
    answer = live_client.post("/register", files=with_request | {"scene": ("s", scene), "object": ("o", data)})
    assert answer.status_code == 202, answer.text
    assert finished(live_client, answer.json()["id"])["error"]["reason"] == "FIELD_REJECTED"
    field = live_client.get(f"/fields/{sha256(data)}").json()
    assert field["state"] == "rejected"
    assert field["error"]["reason"]
    assert_refused(submit(live_client, demo_fields, object=sha256(data)), 422, "FIELD_REJECTED")
    assert not [name for name in live_stack.files() if sha256(data) in name]
    assert live_client.put(f"/fields/{sha256(data)}", content=data).status_code == 201


def test_a_running_job_is_cancelled_within_seconds(
    live_client: httpx.Client, demo_fields: dict[str, str], live_stack: Live
) -> None:
    job_id = submit(live_client, demo_fields, options=ENDLESS, seed=3).json()["id"]
    eventually(lambda: live_client.get(f"/jobs/{job_id}").json()["status"] == "running", "a running job")
    assert live_client.post(f"/jobs/{job_id}/cancel").status_code == 202
    assert finished(live_client, job_id)["status"] == "dismissed"
    assert_refused(live_client.get(f"/jobs/{job_id}/result"), 409, "JOB_DISMISSED")
    assert live_client.delete(f"/jobs/{job_id}").status_code == 204
    assert "libtorch" not in Path(f"/proc/{live_stack.api.pid}/maps").read_text(), "the API has not loaded torch"


# renderings over the wire: real server, real Redis, real worker, real engine on the demo's fields


TRUTH = json.loads((DATA / "truth.json").read_text())["T_object_scene"]["matrix"]
DETECTION = json.loads((DATA / "detection.json").read_text())
OUTPUTS = ["color", "depth", "normal", "animation", "strip", "mesh", "field"]
SMALL: dict[str, Any] = {"size": [32, 24], "orbit": {"frames": 2}, "outputs": ["color"], "before": False}


def substitution(fields: dict[str, str]) -> dict[str, Any]:
    return {"kind": "substitution", "object": fields["object"], "T_object_scene": TRUTH}


def rendered(client: httpx.Client, fields: dict[str, str], **changes: Any) -> dict[str, Any]:
    answer = client.post("/render", json={"scene": fields["scene"], **SMALL, **changes})
    assert answer.status_code in (200, 202), answer.text
    return finished(client, answer.json()["id"])


def result_of(client: httpx.Client, job: dict[str, Any]) -> dict[str, Any]:
    assert job["status"] == "successful", job
    result: dict[str, Any] = client.get(job["links"]["result"]).json()
    validator("RenderResultDocument").validate(result)
    return result


def failed(client: httpx.Client, stack: Live, fields: dict[str, str], reason: str, **changes: Any) -> dict[str, Any]:
    """The problem of a rendering that ends with this reason, of which nothing is left."""
    job = rendered(client, fields, **changes)
    assert job["status"] == "failed", job
    assert job["error"]["reason"] == reason, job["error"]
    assert job["error"]["status"] < 500
    assert not [name for name in stack.files() if name.startswith(f"jobs/{job['id']}/")]
    return dict(job["error"])


@pytest.fixture(scope="module")
def everything(live_stack: Live, demo_fields: dict[str, str]) -> dict[str, Any]:
    with live_stack.client() as client:
        asked = {"outputs": OUTPUTS, "before": True, "mesh_resolution": 32, "field_resolution": 48}
        return result_of(client, rendered(client, demo_fields, edits=[substitution(demo_fields)], **asked))


def test_every_output_is_a_file_that_opens(live_client: httpx.Client, everything: dict[str, Any]) -> None:
    files = {}
    for entry in everything["artifacts"]:
        data = live_client.get(entry["url"]).content
        assert (len(data), sha256(data)) == (entry["bytes"], entry["sha256"])
        files[entry["name"]] = data
    assert {one.get("kind") for one in everything["artifacts"]} >= set(OUTPUTS) - {"field"}
    after, before = (Image.open(io.BytesIO(files[f"{name}-0000.png"])) for name in ("frame", "before"))
    assert after.size == before.size == (32, 24)
    levels = np.asarray(Image.open(io.BytesIO(files["frame-0001-depth.png"])), dtype=np.float64)
    depth = np.load(io.BytesIO(files["frame-0001-depth.npy"]))
    assert np.abs(levels * everything["depth_unit"] - depth).max() <= everything["depth_unit"] * 0.51
    assert (depth > 0).any()
    assert Image.open(io.BytesIO(files["before-after.png"])).size == (70, 24)
    assert getattr(Image.open(io.BytesIO(files["animation.webp"])), "n_frames", 1) == 2
    assert files["composite.glb"][:4] == b"glTF"


def test_the_edited_scene_is_a_field_like_any_other(
    live_client: httpx.Client, demo_fields: dict[str, str], everything: dict[str, Any]
) -> None:
    sha = everything["field"]
    (artifact,) = [one for one in everything["artifacts"] if one["name"] == "edited.safetensors"]
    assert artifact["sha256"] == sha

    def imported() -> dict[str, Any] | None:
        field: dict[str, Any] = live_client.get(f"/fields/{sha}", params={"wait": 5}).json()
        return None if field.get("state") == "validating" else field

    assert eventually(imported, "the import of the edited scene")["state"] == "ready"
    again = {"scene": sha, "object": demo_fields["object"]}
    job = finished(live_client, live_client.post("/register", json=demo_request(again)).json()["id"])
    assert job["status"] == "successful", job
    validator("ResultDocument").validate(live_client.get(job["links"]["result"]).json())


def test_a_registration_and_then_its_rendering(live_client: httpx.Client, demo_fields: dict[str, str]) -> None:
    asked = demo_request(demo_fields, options={})  # as in test_live_jobs: one request is one job
    job = finished(live_client, live_client.post("/register", json=asked).json()["id"])
    assert job["verdict"] == "registered", job
    edit = {"kind": "substitution", "job": job["id"]}
    result = result_of(live_client, rendered(live_client, demo_fields, edits=[edit], outputs=["strip"], before=True))
    assert "before-after.png" in {one["name"] for one in result["artifacts"]}


def deepest_place() -> list[float]:
    scene = open_field(DATA / "mix-room.safetensors")
    low, high = scene.bounds
    steps = torch.linspace(0.0, 1.0, 24)
    points = (low + torch.cartesian_prod(steps, steps, steps) * (high - low)).float()
    found: list[float] = points[scene.signed_distance(points).argmin()].tolist()
    return found


def test_what_only_the_fields_can_tell(
    live_client: httpx.Client, live_stack: Live, demo_fields: dict[str, str]
) -> None:
    edit = substitution(demo_fields)
    twice = [edit, {"kind": "removal", "detection": DETECTION}]
    assert "edits 0 and 1" in failed(live_client, live_stack, demo_fields, "EDIT_INVALID", edits=twice)["detail"]
    far = [*([*row[:3], row[3] + 1000.0] for row in TRUTH[:3]), TRUTH[3]]
    away = [edit | {"T_object_scene": far}]
    failed(live_client, live_stack, demo_fields, "EDIT_INVALID", edits=away)
    station = {"position": deepest_place(), "target": DETECTION["center"]}
    failed(live_client, live_stack, demo_fields, "CAMERA_INVALID", orbit=None, look_at=[station])


def test_a_rendering_that_is_cancelled_leaves_nothing(
    live_client: httpx.Client, live_stack: Live, demo_fields: dict[str, str]
) -> None:
    asked = {"scene": demo_fields["scene"], "size": [640, 480], "orbit": {"frames": 60}, "options": {"mode": "volume"}}
    address = live_client.post("/render", json={**asked, "outputs": ["color"]}).headers["location"]
    eventually(lambda: live_client.get(address).json()["phase"] == "rendering" or None, "a rendering that goes on")
    assert live_client.post(f"{address}/cancel").status_code == 202
    assert finished(live_client, address.rpartition("/")[2])["status"] == "dismissed"
    assert not [name for name in live_stack.files() if name.startswith(f"{address[1:]}/")]


@pytest.mark.long
def test_one_frame_in_one_call_ends_in_a_pose_and_its_picture(live_client: httpx.Client) -> None:
    """The example's frame, mask and model."""
    files = DATA / "frame"
    parts = {name: (name, (files / f"{name}.png").read_bytes()) for name in ("depth", "color", "mask")}
    parts |= {"object": ("cat.stl", (files / "cat.stl").read_bytes())}
    texts = {"camera": (None, (files / "camera.json").read_bytes()), "request": (None, b"{}")}
    answer = live_client.post("/register", files={**parts, **texts})
    assert answer.status_code == 202, answer.text
    job = finished(live_client, answer.json()["id"])
    result = live_client.get(job["links"]["result"]).json()
    validator("ResultDocument").validate(result)
    truth = np.array(json.loads((files / "truth.json").read_text())["T_camera_object"])
    assert np.abs(np.array(result["camera"]["T_camera_object"]["matrix"]) - truth)[:3, 3].max() < 0.005
    assert result["verdict"] == "registered"
    (overlay,) = [one for one in result["artifacts"] if one["name"] == "overlay.png"]
    shown = arrived(live_client, overlay["url"])
    assert shown.status_code == 200, shown.text
    with Image.open(BytesIO(shown.content)) as image:
        assert image.format == "PNG"
    recording = live_client.get(f"/recordings/{job['inputs']['scene']}").json()
    assert recording["report"]["kind"] == "recording"
    assert live_client.get(recording["links"]["picture"]).headers["content-type"] == "image/png"
    assert live_client.delete(recording["links"]["self"]).status_code == 204
    assert_refused(live_client.get(recording["links"]["picture"]), 404, "FIELD_NOT_FOUND")
