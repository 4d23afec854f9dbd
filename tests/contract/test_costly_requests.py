"""Small requests that would cost much: JSON of many values, tokens by the thousand, parameters by the thousand."""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import yaml

from regnf_core.options import RegistrationOptions
from regnf_core.rendering.request import RenderOptions
from regnf_service.http import body as parsing
from regnf_service.http.schemas import reading
from regnf_service.http.strict_json import MOST_VALUES, count_values
from tests.contract.world import BOX, World, assert_refused, field_bytes, sha256, transform

SEARCH = {"scene": "a" * 64, "detection": BOX, "candidates": [{"field": f"{n:064x}"} for n in range(512)]}


@pytest.mark.parametrize(
    "body",
    [
        json.dumps({f"member{n}": n for n in range(80_000)}),
        "[" + ",".join(["[]"] * 5000) + "]",
        '{"a":' * 5000 + "1" + "}" * 5000,
        json.dumps({"detection": BOX | {f"m{n}": 1 for n in range(300)}}),
        json.dumps({"options": {"refinement": {f"m{n}": 1 for n in range(300)}}}),
    ],
    ids=["members", "lists", "depth", "detection", "options"],
)
def test_json_of_too_many_values_is_not_looked_at(world: World, body: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reading, "_adapter", None)
    assert_refused(post(world, body), 413, "REQUEST_TOO_LARGE")


def post(world: World, body: str) -> Any:
    return world.client.post("/register", content=body, headers={"Content-Type": "application/json"})


def test_the_largest_request_of_the_contract_fits(world: World) -> None:
    text = json.dumps(SEARCH | {"options": {"preset": "robust"}}, indent=4)
    assert count_values(text.encode()) < MOST_VALUES / 2
    assert_refused(post(world, text), 404, "FIELD_NOT_FOUND")


def test_few_of_many_faults_are_worked_out(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    looked = []
    meant = reading._meant
    monkeypatch.setattr(reading, "_meant", lambda place, model: looked.append(place) or meant(place, model))
    problem = assert_refused(post(world, json.dumps({f"m{n}": 1 for n in range(250)})), 422, "INVALID_DETECTION")
    assert len(problem["errors"]) == 32
    assert len(looked) <= 32


def test_a_large_body_is_read_beside_the_event_loop(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    names = []
    read = parsing.read_model
    monkeypatch.setattr(
        parsing, "read_model", lambda *given: names.append(threading.current_thread().name) or read(*given)
    )
    assert_refused(post(world, json.dumps(SEARCH)), 404, "FIELD_NOT_FOUND")
    assert_refused(post(world, json.dumps(SEARCH | {"candidates": SEARCH["candidates"][:1]})), 404, "FIELD_NOT_FOUND")
    assert "worker" in names[0]
    assert "worker" not in names[1]


def test_an_option_in_a_description_is_unknown_there(world: World) -> None:
    """Its place has one step alone, which the search for what was meant did not expect."""
    files = {"file": ("f", field_bytes("described")), "description": (None, json.dumps({"options": {}}))}
    assert_refused(world.client.post("/fields", files=files), 422, "INVALID_OPTIONS")


def test_many_parameters_are_not_looked_at(world: World) -> None:
    query = "&".join(f"p{n}=1" for n in range(2000))
    assert "At most" in assert_refused(world.client.get(f"/fields?{query}"), 400, "INVALID_QUERY")["detail"]


def test_what_a_form_can_send_without_asking_is_refused(world: World) -> None:
    for kind in ("text/plain", "text/plain;charset=UTF-8", "TEXT/xml"):
        for path, content in (("/fields", field_bytes("form")), ("/register", b"{}")):
            answer = world.client.post(path, content=content, headers={"Content-Type": kind})
            assert_refused(answer, 415, "UNSUPPORTED_MEDIA_TYPE")


def test_labels_break_no_lines_and_turn_no_text(world: World) -> None:
    for label in ("a\u0085b", "a\u2028b", "a\u2029b", "a\x9fb", "a\u200fb", "\u061ca", "a\ufeff"):
        request = world.valid_request() | {"detection": BOX | {"label": label}}
        assert_refused(world.client.post("/register", json=request), 422, "INVALID_DETECTION")
        files = {"file": ("f", field_bytes("labeled")), "description": (None, json.dumps({"label": label}))}
        assert_refused(world.client.post("/fields", files=files), 422, "INVALID_DESCRIPTION")


# numbers as large as JSON and addresses can write them are refused, or taken: never an internal error


_CONTRACT: dict[str, Any] = yaml.safe_load((Path(__file__).parents[2] / "openapi.yaml").read_text(encoding="utf-8"))
HUGE = [2**31, 2**63, -(2**63), 10**309, 10**4000, -1e308, 5e-324]
"""Beyond what 32 and 64 bits hold, what a float holds, and what a number of digits can be read; and the least float."""
OBJECT, MATRIX = sha256(field_bytes("object")), transform(2.0)["matrix"]
EDIT = {"kind": "substitution", "object": OBJECT, "T_object_scene": MATRIX, "tint": [1, 0, 0]}
POSE = {"T_scene_camera": transform()["matrix"], "intrinsics": [50, 50, 32, 24], "size": [64, 48]}
STATION = {"position": [0.9, 0.0, 0.5], "target": [0.0, 0.0, 0.0]}
QUERIES = [
    (path, parameter["name"])
    for path, item in _CONTRACT["paths"].items()
    for parameter in item.get("get", {}).get("parameters", ())
    if parameter["in"] == "query" and "integer" in json.dumps(parameter["schema"])
]
ORBIT: dict[str, Any] = {
    "edits": [EDIT], "orbit": {"edit": 0, "frames": 2}, "size": [64, 48], "options": asdict(RenderOptions()),
    "mesh_resolution": 64, "field_resolution": 64, "seed": 1,
}  # fmt: skip
TURNED = {"center": [0, 0, 0], "size": [1, 1, 1], "rotation_quaternion_wxyz": [1, 0, 0, 0]}
STARTED = {"seed": 1, "initial_transform": {"matrix": MATRIX}, "options": asdict(RegistrationOptions())}
ENTRY = {"field": OBJECT, "name": "chair", "symmetry": {"order": 2, "axis": [0, 0, 1], "continuous": True}}
SAID = {"bounds": [[-1, -1, -1], [1, 1, 1]], "latent_index": 0, "output_column": 0}
BODIES: dict[str, tuple[str, str, dict[str, Any]]] = {
    "a registration": ("POST", "/register", STARTED),
    "a box that is turned": ("POST", "/register", {"detection": TURNED}),
    "a rendering of an orbit": ("POST", "/render", ORBIT),
    "a rendering of poses": ("POST", "/render", {"poses": [POSE]}),
    "a rendering of stations": ("POST", "/render", {"look_at": [STATION]}),
    "an entry of the library": ("POST", "/library", ENTRY),
    "a description": ("PATCH", f"/fields/{OBJECT}", {"description": SAID}),
}


def test_in_an_address(world: World) -> None:
    request = world.valid_request()
    job = world.client.post("/register", json=request).json()["id"]
    headers = {"Content-Type": "application/x-ndjson"}
    batch = world.client.post("/batches", content=json.dumps(request), headers=headers).json()["id"]
    for path, name in QUERIES:
        place = path.format(id=batch if path.startswith("/batches") else job, sha256=OBJECT, name="result.json")
        for value in HUGE:
            answer = world.client.get(f"{place}?{name}={value}")
            assert answer.status_code < 500, (place, name, str(value)[:12])


@pytest.mark.parametrize("body", BODIES)
def test_in_a_body(world: World, body: str) -> None:
    method, path, members = BODIES[body]
    request = world.valid_request()
    if path == "/register":
        members = request | members
    elif path == "/render":
        members = {"scene": request["scene"]} | members
    text = json.dumps(members)
    answer = send(world, method, path, text)
    assert answer.status_code not in (400, 415, 422), f"it is no request as it stands: {answer.text}"
    tried = list(changed_numbers(text))
    assert len(tried) >= 3 * len(HUGE)
    for changed in tried:
        answer = send(world, method, path, changed)
        assert answer.status_code < 500, (changed[:2000], answer.text)


def send(world: World, method: str, path: str, text: str) -> Any:
    return world.client.request(method, path, content=text, headers={"Content-Type": "application/json"})


def changed_numbers(text: str) -> Iterator[str]:
    """The body with each of its numbers in turn replaced by each of the huge ones."""
    for found in re.finditer(r"(?<=[\[ ])-?[\d.]+(?:e[+-]?\d+)?(?=[,\]}])", text):
        for value in HUGE:
            yield text[: found.start()] + json.dumps(value) + text[found.end() :]


def test_in_a_header(world: World) -> None:
    job = world.client.post("/register", json=world.valid_request()).json()["id"]
    world.succeed(job, {"result.glb": bytes(100)})
    artifact, put = f"/jobs/{job}/artifacts/result.glb", f"/fields/{sha256(field_bytes('other'))}"
    for value in HUGE[:5]:
        for span in (f"bytes={value}-", f"bytes=-{value}", f"bytes=0-{value}", f"bytes={value}-{value}"):
            assert world.client.get(artifact, headers={"Range": span}).status_code < 500, span
        for span in (f"bytes 0-{value}/{value}", f"bytes */{value}", f"bytes {value}-{value}/10"):
            assert world.client.put(put, content=b"12", headers={"Content-Range": span}).status_code < 500, span
        assert world.client.get(f"/jobs/{job}/events", headers={"Last-Event-ID": str(value)}).status_code < 500
