"""The rows that matter most, end to end: a real server, a real worker, the gate in its process, the real engine."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import httpx
import pytest

from regnf_state.room import QUESTIONS
from tests.contract.live import Live, eventually
from tests.contract.world import assert_refused
from tests.core.importing.fuzzing.seeds import Seeds
from tests.gate.bad_containers import CONTAINERS
from tests.gate.bad_pickles import PICKLES
from tests.gate.bad_tensors import TENSORS
from tests.listing import below
from tests.live_stack import DATA, LIVE, demo_request, finished, imported

pytestmark = LIVE
FILES = {
    **{row: CONTAINERS[row] for row in ("truncated", "deflate bomb")},
    **{row: PICKLES[row] for row in ("os.system",)},
    **{row: TENSORS[row] for row in ("NaN weights", "a constant field")},
}
NOTHING_FOUND = {("failed", "NO_SURFACE_IN_DETECTION"), ("failed", "NO_INITIAL_TRANSFORM")}
"""Honest ends of a registration of what has nothing, or too much, in common, with as little work as these do."""


@pytest.mark.parametrize("row", FILES)
def test_a_bad_file_is_rejected_and_leaves_nothing(
    live_stack: Live, live_client: httpx.Client, seeds: Seeds, row: str
) -> None:
    build, outcome = FILES[row]
    field = imported(live_client, build(seeds))
    assert f"{field['state']} {field['error']['reason']}" == outcome
    left = {Path(name).name for name in live_stack.files() if field["sha256"] in name}
    assert left == ({"original"} if field["error"]["reason"] in QUESTIONS else set())
    scratch = live_stack.folder / "scratch"
    eventually(lambda: not [path for path in below(scratch) if "import-" in path.name], "an empty scratch folder")


def test_the_next_good_file_is_taken(live_client: httpx.Client, seeds: Seeds) -> None:
    """After all of the above, by the same worker; what its process gave up is part of the report."""
    field = imported(live_client, seeds.field_file)
    assert field["state"] == "ready"
    assert field["report"]["isolation"]["no_new_privileges"]


def outcome_of(client: httpx.Client, request: dict[str, Any]) -> tuple[str, str]:
    """How the job ends: status, and its reason or verdict. Any reason but a fault of the service."""
    answer = client.post("/register", json=demo_request({}, **request))
    assert answer.status_code in (200, 202), answer.text
    job = finished(client, answer.json()["id"])
    result = client.get(f"/jobs/{job['id']}/result")
    if job["status"] == "failed":
        assert assert_refused(result, 409, "JOB_FAILED")["error"] == job["error"]
        return "failed", job["error"]["reason"]
    return job["status"], result.json()["verdict"]


def test_scene_and_object_swapped(live_client: httpx.Client, demo_fields: dict[str, str]) -> None:
    """Nothing tells that a field was meant as the other one; but the box holds no room, and the job says so."""
    ended = outcome_of(live_client, {"scene": demo_fields["object"], "object": demo_fields["scene"]})
    assert ended in NOTHING_FOUND or ended[1] != "registered"


def test_the_same_file_twice(live_client: httpx.Client, demo_fields: dict[str, str]) -> None:
    ended = outcome_of(live_client, {"scene": demo_fields["scene"], "object": demo_fields["scene"]})
    assert ended in NOTHING_FOUND or ended[0] == "successful"


def test_a_sliver(live_client: httpx.Client, demo_fields: dict[str, str]) -> None:
    box = json.loads((DATA / "detection.json").read_text()) | {"size": [1e-6, 1e-6, 1e-6]}
    assert outcome_of(live_client, {**demo_fields, "detection": box}) == ("failed", "NO_SURFACE_IN_DETECTION")


def test_the_whole_scene(live_client: httpx.Client, demo_fields: dict[str, str]) -> None:
    lower, upper = live_client.get(f"/fields/{demo_fields['scene']}").json()["report"]["bounds"]
    ended = outcome_of(live_client, {**demo_fields, "detection": {"min": lower, "max": upper}})
    assert ended in NOTHING_FOUND or ended[0] == "successful"


def test_millimeters_for_meters(live_client: httpx.Client, demo_fields: dict[str, str]) -> None:
    box = json.loads((DATA / "detection.json").read_text())
    scaled = {name: [1000 * value for value in box[name]] for name in ("center", "size")}
    answer = live_client.post("/register", json={**demo_fields, "detection": box | scaled})
    assert_refused(answer, 422, "DETECTION_OUTSIDE_SCENE")
