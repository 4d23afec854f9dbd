"""The library: entries by name, and requests that name objects by them."""

from __future__ import annotations

from typing import Any

import httpx
import pytest

from regnf_core.library_entries import MAX_TAGS
from regnf_service.concurrency import in_thread
from regnf_service.http import batch_intake
from regnf_state.queue import Work
from tests.contract.world import World, assert_refused, pointers

TURNED = {"order": 2, "axis": [0.0, 0.0, 2.0], "continuous": True}
UNIT = TURNED | {"axis": [0.0, 0.0, 1.0]}
FOUND = {"order": 1, "axis": None, "continuous": False}


def add(world: World, field: str, name: str = "office chair", **notes: Any) -> httpx.Response:
    return world.client.post("/library", json={"name": name, "field": field, **notes})


def listed(world: World, **query: Any) -> list[str]:
    return [entry["name"] for entry in world.client.get("/library", params=query).json()["entries"]]


def test_an_entry_from_its_making_to_its_end(world: World) -> None:
    chair = world.ready_field("chair")
    made = add(world, chair, tags=["seat", "oak", "seat"], unit="cm", note="of the hall", symmetry=TURNED)
    assert (made.status_code, made.headers["location"]) == (201, "/library/office%20chair")
    entry = world.client.get(made.headers["location"]).json()
    assert entry == made.json()
    assert entry | {"field": chair, "tags": ["oak", "seat"], "unit": "cm", "note": "of the hall", "symmetry": UNIT,
                    "symmetry_source": "said", "state": "ready"} == entry  # fmt: skip
    assert entry["links"]["preview"] == f"/fields/{chair}/preview.png"
    assert world.client.get(f"/fields/{chair}").json()["library"] == {"name": "office chair", "tags": ["oak", "seat"]}
    assert add(world, chair, tags=["seat", "oak"], unit="cm", note="of the hall", symmetry=TURNED).status_code == 200
    renamed = world.client.patch(made.headers["location"], json={"name": "armchair", "symmetry": None, "tags": []})
    assert renamed.status_code == 200
    assert (renamed.json()["tags"], renamed.json()["note"]) == ([], "of the hall")
    assert (renamed.json()["symmetry"], renamed.json()["symmetry_source"]) == (None, None)
    assert_refused(world.client.get(made.headers["location"]), 404, "LIBRARY_ENTRY_NOT_FOUND")
    assert_refused(world.client.delete(f"/fields/{chair}"), 409, "FIELD_IN_LIBRARY")
    assert world.client.delete("/library/armchair").status_code == 204
    assert (listed(world), world.client.get(f"/fields/{chair}").json()["library"]) == ([], None)
    assert world.client.delete(f"/fields/{chair}").status_code == 204


def test_the_detected_symmetry_holds_until_another_is_said(world: World) -> None:
    """What has a default may be left out of what is said, and what a change leaves out stays."""
    chair = world.ready_field("chair")
    add(world, chair)
    world.records.update_field(chair, symmetry=FOUND)

    def said(symmetry: Any) -> tuple[Any, str]:
        told = world.client.patch("/library/office chair", json={"symmetry": symmetry}).json()
        return told["symmetry"], told["symmetry_source"]

    assert world.client.get("/library/office chair").json()["symmetry_source"] == "detected"
    assert said(TURNED) == (UNIT, "said")
    assert said({"order": 1}) == (UNIT | {"order": 1}, "said")
    refused = world.client.patch("/library/office chair", json={"symmetry": {"order": 4}})
    assert_refused(refused, 422, "INVALID_REQUEST")  # a continuous one has the order 1 or 2
    assert world.client.get("/library/office chair").json()["symmetry"] == UNIT | {"order": 1}
    assert said(None) == (FOUND, "detected")
    assert said({"order": 4}) == ({"order": 4, "axis": None, "continuous": False}, "said")
    assert said({"axis": [0, 0, 3], "order": 2}) == ({"order": 2, "axis": [0.0, 0.0, 1.0], "continuous": False}, "said")


def test_a_worker_is_asked_for_the_model_once(world: World) -> None:
    chair, waiting = world.ready_field("chair"), world.ready_field("table")
    world.queue.imports.clear()
    add(world, chair)
    assert world.queue.imports == [(chair, 1)]
    assert world.queue.holds(Work("import", chair, 1).name)
    world.records.update_field(waiting, symmetry=FOUND)
    add(world, waiting, "table")
    assert world.queue.imports == [(chair, 1)], "its model was made by a job"


def test_names_are_each_ones_own(world: World) -> None:
    chair, table = world.ready_field("chair"), world.ready_field("table")
    add(world, chair)
    assert_refused(add(world, table), 409, "LIBRARY_NAME_TAKEN")
    assert_refused(add(world, chair, "stool"), 409, "FIELD_IN_LIBRARY")
    add(world, table, "table")
    assert_refused(world.client.patch("/library/table", json={"name": "office chair"}), 409, "LIBRARY_NAME_TAKEN")
    assert world.client.patch("/library/table", json={"name": "Bürotisch (2.1)"}).status_code == 200
    assert listed(world) == ["Bürotisch (2.1)", "office chair"]
    assert world.client.get("/library/Bürotisch (2.1)").status_code == 200
    assert add(world, world.ready_field("new"), "table").status_code == 201, "the old name is free"


def test_lists_are_filtered_and_paged(world: World) -> None:
    for number in range(5):
        add(world, world.ready_field(f"f{number}"), f"Chair {number}", tags=["odd" if number % 2 else "even", "all"])
    assert listed(world) == [f"Chair {number}" for number in (4, 3, 2, 1, 0)]
    assert listed(world, tag="odd") == ["Chair 3", "Chair 1"]
    assert listed(world, name="chAIR 2") == ["Chair 2"]
    assert listed(world, tag="none") == []
    first = world.client.get("/library", params={"limit": 2}).json()
    rest = world.client.get("/library", params={"page_token": first["next_page_token"]}).json()
    assert [len(first["entries"]), len(rest["entries"]), rest["next_page_token"]] == [2, 3, None]


WRONG: dict[str, list[tuple[Any, str]]] = {
    "name": [(name, "") for name in ("", ".hidden", "a/b", "ends with a space ", "new\nline", "x" * 65, None)],
    "tags": [(["a", "b\u202e"], "/1"), ([str(n) for n in range(MAX_TAGS + 1)], "")],
    "unit": [("parsec", "")],
    "note": [("n" * 501, "")],
    "symmetry": [
        ({"order": 0}, "/order"), ({"order": 2, "axis": [0, 0, 0]}, ""), ({"order": 1, "continuous": True}, ""),
        ({"order": 4, "axis": [0, 0, 1], "continuous": True}, ""),
    ],
    "field": [("chair", "")],
    "colour": [("red", "")],
}  # fmt: skip


def test_what_is_no_entry_is_pointed_at(world: World) -> None:
    chair = world.ready_field("chair")
    for member, values in WRONG.items():
        for value, below in values:
            answer = world.client.post("/library", json={"name": "chair", "field": chair} | {member: value})
            assert pointers(assert_refused(answer, 422, "INVALID_REQUEST"))[0] == f"/{member}{below}"
    assert listed(world) == []


def test_fields_that_are_none_become_no_entries(world: World) -> None:
    assert_refused(add(world, "0" * 64), 404, "FIELD_NOT_FOUND")
    assert_refused(add(world, world.rejected_field("bad")), 422, "FIELD_REJECTED")
    for method, path in (("GET", ""), ("PATCH", ""), ("DELETE", ""), ("GET", "/file")):
        body = {"tags": []} if method == "PATCH" else None
        answer = world.client.request(method, f"/library/none{path}", json=body)
        assert_refused(answer, 404, "LIBRARY_ENTRY_NOT_FOUND")


def test_the_safe_field_is_handed_out(world: World) -> None:
    chair = world.ready_field("chair")
    world.blobs.put(f"fields/{chair}/field.safetensors", b"safe bytes" * 100_000)
    add(world, chair)
    answer = world.client.get("/library/office chair/file")
    assert (answer.status_code, answer.content) == (200, b"safe bytes" * 100_000)
    assert answer.headers["content-length"] == "1000000"


def register(world: World, dry_run: bool = True, **named: Any) -> httpx.Response:
    request = world.valid_request()
    request.pop("object")
    return world.client.post(f"/register?dry_run={str(dry_run).lower()}", json=request | named)


def test_requests_name_objects_by_entries(world: World) -> None:
    """The job is that of the fields: the names say which, and nothing else."""
    chair, stool, table = (world.ready_field(name) for name in ("chair", "stool", "table"))
    for name, field, tags in (("chair", chair, ["seat"]), ("stool", stool, ["seat", "round"]), ("table", table, [])):
        add(world, field, name, tags=tags)
    by_name = register(world, object={"library": "chair"}).json()
    assert by_name == register(world, object=chair).json()
    for wanted, meant in (
        ({"tags": ["seat"]}, {chair, stool}),
        ({"names": ["table"], "tags": ["round"]}, {table, stool}),
        ({"names": ["table", "chair"]}, {table, chair}),
        ({}, {chair, stool, table}),
    ):
        found = register(world, candidates={"library": wanted}).json()
        assert set(found["request"]["candidates"]) == meant
        assert found == register(world, candidates=sorted(meant)).json()


def test_entries_are_selected_a_page_at_a_time(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    chairs = [world.ready_field(f"chair {number}") for number in range(5)]
    for number, field in enumerate(chairs):
        add(world, field, f"chair {number}", tags=["seat"])
    monkeypatch.setattr(batch_intake, "LOOKED_AT", 2)
    pages = 0

    async def counted(work: Any, *given: Any) -> Any:
        nonlocal pages
        pages += 1
        return await in_thread(work, *given)

    monkeypatch.setattr(batch_intake, "in_thread", counted)
    found = register(world, candidates={"library": {"tags": ["seat"]}}).json()
    assert (set(found["request"]["candidates"]), pages) == (set(chairs), 3)
    register(world, candidates={"library": {"names": ["chair 1"]}})
    assert pages == 3, "names alone need none"


def test_what_names_no_entry_is_pointed_at(world: World) -> None:
    add(world, world.ready_field("chair"), "chair")
    unknown, wrong = (404, "LIBRARY_ENTRY_NOT_FOUND"), (422, "INVALID_REQUEST")
    cases: list[tuple[dict[str, Any], tuple[int, str], str]] = [
        ({"object": {"library": "none"}}, unknown, "/object/library"),
        ({"candidates": {"library": {"names": ["chair", "none"]}}}, unknown, "/candidates/library/names/1"),
        ({"candidates": {"library": {"tags": ["none"]}}}, (422, "LIBRARY_EMPTY"), "/candidates/library"),
        ({"candidates": {"library": {"tags": []}}}, wrong, "/candidates/library/tags"),
        ({"candidates": {"library": {"tag": "x"}}}, wrong, "/candidates/library/tag"),
        ({"candidates": {"library": "chair"}}, wrong, "/candidates/library"),
        ({"object": {"library": "a/b"}}, wrong, "/object/library"),
        ({"object": {"library": "chair", "field": "0" * 64}}, wrong, "/object/field"),
        ({"object": "chair"}, wrong, "/object"),
    ]
    for named, refusal, pointer in cases:
        assert pointers(assert_refused(register(world, **named), *refusal))[0] == pointer, named


def test_a_rejected_entry_is_refused_by_name_and_left_out_by_tag(world: World) -> None:
    chair, other = world.ready_field("chair"), world.ready_field("other")
    for name, field in (("chair", chair), ("other", other)):
        add(world, field, name, tags=["seat"])
    known = world.records.get_field(other)
    assert known is not None
    world.records.reimport_field(known, {"sign": -1}, None)
    world.records.update_field(other, state="rejected", error={"reason": "FIELD_SHAPES_MISMATCH"})
    assert_refused(register(world, object={"library": "other"}), 422, "FIELD_REJECTED")
    assert register(world, candidates={"library": {}}).json()["request"]["candidates"] == [chair]
    assert world.client.get("/library/other").json()["state"] == "rejected"
