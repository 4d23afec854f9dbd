"""Renderings over the wire: real server, real Redis, real worker, real engine on the demo's fields."""

from __future__ import annotations

import io
import json
from typing import Any

import httpx
import numpy as np
import pytest
import torch
from PIL import Image

from regnf_core.fields.build import open_field
from tests.contract.live import Live, eventually
from tests.contract.test_openapi import validator
from tests.contract.world import sha256
from tests.live_stack import DATA, LIVE, demo_request, finished

pytestmark = LIVE
TRUTH = json.loads((DATA / "truth.json").read_text())["T_object_scene"]["matrix"]
DETECTION = json.loads((DATA / "detection.json").read_text())
OUTPUTS = ["color", "depth", "normal", "animation", "strip", "mesh", "field"]
SMALL: dict[str, Any] = {"size": [32, 24], "orbit": {"frames": 2}, "outputs": ["color"], "before": False}


def substitution(fields: dict[str, str]) -> dict[str, Any]:
    return {"kind": "substitution", "object": fields["object"], "T_object_scene": TRUTH}


def rendered(client: httpx.Client, fields: dict[str, str], **changes: Any) -> dict[str, Any]:
    """The document of a rendering's job once it has ended."""
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
    """The result of a substitution with every output."""
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
    picture = result_of(live_client, rendered(live_client, again, edits=[substitution(demo_fields)]))
    assert picture["frames"] == 2
    answer = live_client.post("/register?dry_run=true", json=demo_request(again))
    assert (answer.status_code, answer.json()["valid"]) == (200, True)


def test_a_registration_and_then_its_rendering(live_client: httpx.Client, demo_fields: dict[str, str]) -> None:
    asked = demo_request(demo_fields, options={})  # as in test_live_jobs: one request is one job
    job = finished(live_client, live_client.post("/register", json=asked).json()["id"])
    assert job["verdict"] == "registered", job
    edit = {"kind": "substitution", "job": job["id"]}
    result = result_of(live_client, rendered(live_client, demo_fields, edits=[edit], outputs=["strip"], before=True))
    assert "before-after.png" in {one["name"] for one in result["artifacts"]}


def deepest_place() -> list[float]:
    """A place in the scene's matter."""
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
