"""Small requests that would cost much: JSON of many values, tokens by the thousand, parameters by the thousand."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from redis import Redis

from regnf_service.http import body as parsing
from regnf_service.http.schemas import reading
from regnf_service.http.strict_json import MOST_VALUES, count_values
from tests.contract.world import BOX, World, assert_refused, field_bytes, make_world

ALICE = {"Authorization": "Bearer open-sesame-open-sesame"}
SEARCH = {"scene": "a" * 64, "detection": BOX, "candidates": [{"field": f"{n:064x}"} for n in range(512)]}


@pytest.fixture
def guarded(tmp_path: Path, any_redis: Redis) -> Iterator[World]:
    made = make_world(tmp_path, any_redis, api_tokens=frozenset({"alice:open-sesame-open-sesame"}))
    with made.client:
        yield made


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


@pytest.mark.parametrize("kind", ["text/plain", "text/plain;charset=UTF-8", "TEXT/xml"])
def test_what_a_form_can_send_without_asking_is_refused(world: World, kind: str) -> None:
    answer = world.client.post("/fields", content=field_bytes("form"), headers={"Content-Type": kind})
    assert_refused(answer, 415, "UNSUPPORTED_MEDIA_TYPE")
    assert_refused(
        world.client.post("/register", content=b"{}", headers={"Content-Type": kind}), 415, "UNSUPPORTED_MEDIA_TYPE"
    )


@pytest.mark.parametrize("label", ["a\u0085b", "a\u2028b", "a\u2029b", "a\x9fb", "a\u200fb", "\u061ca", "a\ufeff"])
def test_labels_break_no_lines_and_turn_no_text(world: World, label: str) -> None:
    request = world.valid_request() | {"detection": BOX | {"label": label}}
    assert_refused(world.client.post("/register", json=request), 422, "INVALID_DETECTION")
    files = {"file": ("f", field_bytes("labeled")), "description": (None, json.dumps({"label": label}))}
    assert_refused(world.client.post("/fields", files=files), 422, "INVALID_DESCRIPTION")
