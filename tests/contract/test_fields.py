"""Fields over HTTP: upload, look, list, delete."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import httpx
import pytest

from tests.contract.conftest import announced
from tests.contract.world import World, assert_refused, field_bytes, put, sha256

A, B = field_bytes("a"), field_bytes("b")
PLACE, KEY = f"/fields/{sha256(A)}", f"fields/{sha256(A)}/original"


def test_put_stores_the_bytes_and_queues_their_import_once(world: World) -> None:
    answer = put(world.client, A, **{"Content-Digest": announced(A)})
    assert (answer.status_code, answer.headers["location"]) == (201, PLACE)
    document = answer.json()
    assert (document["state"], document["bytes"], document["sha256"]) == ("validating", len(A), sha256(A))
    assert put(world.client, A).status_code == 200
    assert (world.blobs.blobs, world.queue.imports) == ({KEY: A}, [(sha256(A), 1)])
    world.queue.lose()
    put(world.client, A)
    assert world.queue.imports == [(sha256(A), 1)], "it was never queued"


def test_an_import_that_waits_says_how_many_are_before_it(world: World) -> None:
    for data in (A, B):
        put(world.client, data)
    assert world.client.get(f"/fields/{sha256(B)}").json()["queue_position"] == 2
    listed = world.client.get("/fields", headers={"Accept": "application/json"}).json()["fields"]
    assert [one["queue_position"] for one in listed] == [None, None]


def test_bytes_that_are_held_safely_are_not_kept_again(world: World) -> None:
    world.ready_field("a")
    assert put(world.client, A).status_code == 200
    assert world.blobs.blobs == {}


def test_a_rejected_field_can_be_uploaded_again(world: World) -> None:
    world.rejected_field("a")
    assert world.client.get(PLACE).json()["error"]["reason"] == "FIELD_SHAPES_MISMATCH"
    answer = put(world.client, A)
    assert (answer.status_code, answer.json()["state"], answer.json()["error"]) == (201, "validating", None)
    assert world.queue.imports[-1] == (sha256(A), 2)
    assert KEY in world.blobs.blobs


def test_post_computes_the_digest(world: World) -> None:
    answer = world.client.post("/fields", content=A)
    assert (answer.status_code, answer.headers["location"]) == (201, PLACE)


def test_a_description_beside_the_file_makes_it_that_function(world: World) -> None:
    def post(**said: Any) -> httpx.Response:
        return world.client.post("/fields", files={"file": ("a", A), "description": (None, json.dumps(said))})

    said = {"family": "neus-facto", "level_mask": 8, "hash": {"features_per_level": 2}}
    answer = post(**said, label="room")
    assert answer.status_code == 201, answer.text
    assert (answer.json()["label"], answer.json()["description"]) == ("room", said)
    assert world.blobs.blobs == {KEY: A}
    assert post(**said, label="named later").json()["label"] == "named later"
    assert_refused(post(**said | {"level_mask": 4}), 409, "FIELD_DESCRIPTION_DIFFERS")
    assert put(world.client, A).status_code == 200


@pytest.mark.parametrize("state", ["validating", "ready", "rejected"])
def test_head_is_get_without_content(world: World, state: str) -> None:
    put(world.client, A)
    if state != "validating":
        world.records.update_field(sha256(A), attempt=1, state=state)
    get, head = world.client.get(PLACE), world.client.head(PLACE)
    assert (head.status_code, head.content) == (get.status_code, b"") == (200, b"")
    own = {"x-request-id", "date"}
    told = [{name: value for name, value in one.headers.items() if name not in own} for one in (get, head)]
    assert told[0] == told[1]
    assert ("retry-after" in head.headers) == (state == "validating")
    assert get.json()["state"] == state
    assert world.client.head(f"/fields/{sha256(B)}").status_code == 404


def test_get_may_wait_for_the_import(world: World) -> None:
    put(world.client, A)
    waited = world.client.get(PLACE, params={"wait": 1})
    assert (waited.json()["state"], waited.headers["retry-after"]) == ("validating", "1")
    world.records.update_field(sha256(A), attempt=1, state="ready", report={"bounds": [[-1, -1, -1], [1, 1, 1]]})
    document = world.client.get(PLACE, params={"wait": 20}).json()
    assert (document["state"], document["report"]["bounds"][0]) == ("ready", [-1, -1, -1])


def test_lists_go_page_by_page_and_by_label(world: World) -> None:
    known = [world.ready_field(name) for name in "abc"]
    world.records.update_field(known[1], label="chair")
    first = world.client.get("/fields", params={"limit": 2}).json()
    second = world.client.get("/fields", params={"limit": 2, "page_token": first["next_page_token"]}).json()
    assert [field["sha256"] for field in first["fields"] + second["fields"]] == known[::-1]
    assert second["next_page_token"] is None
    labeled = world.client.get("/fields", params={"label": "chair"}).json()
    assert [field["sha256"] for field in labeled["fields"]] == [known[1]]


def test_a_page_may_be_empty_and_not_the_last(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("regnf_state.redis.documents.LOOKED_AT", 2)
    known = [world.ready_field(name) for name in "abcde"]
    world.records.update_field(known[0], label="chair")
    world.submit()
    params = {"label": "chair", "limit": "1"}
    pages = [world.client.get("/fields", params=params).json()]
    while (token := pages[-1]["next_page_token"]) is not None:
        pages.append(world.client.get("/fields", params=params | {"page_token": token}).json())
    assert pages[0]["fields"] == []
    assert [field["sha256"] for page in pages for field in page["fields"]] == [known[0]]
    world.submit(seed=1)
    page = world.client.get("/jobs", params={"status": "failed", "limit": 1}).json()
    assert (page["jobs"], page["next_page_token"] is not None) == ([], True)


def test_delete_leaves_nothing_in_the_store_or_the_queue(world: World) -> None:
    for _ in range(3):
        assert put(world.client, A).status_code == 201
        assert len(world.queue.waiting) == 1
        assert world.client.delete(PLACE).status_code == 204
        assert (world.queue.waiting, world.blobs.blobs) == ([], {})
    for method in ("GET", "DELETE"):
        assert_refused(world.client.request(method, PLACE), 404, "FIELD_NOT_FOUND")


def test_a_field_that_a_job_needs_is_not_deleted(world: World) -> None:
    job_id = world.submit()
    scene = world.valid_request()["scene"]
    assert_refused(world.client.delete(f"/fields/{scene}"), 409, "FIELD_IN_USE")
    world.succeed(job_id)
    assert world.client.delete(f"/fields/{scene}").status_code == 204


def test_v1_is_the_same_service(world: World) -> None:
    assert world.client.put(f"/v1{PLACE}", content=A).headers["location"] == f"/v1{PLACE}"
    assert world.client.get(PLACE).json()["links"]["self"] == PLACE


def test_uploads_far_larger_than_a_block_arrive_whole(worlds: Callable[..., World]) -> None:
    world = worlds(max_upload_bytes=8 << 20)
    data = field_bytes("large", 3 * (1 << 20) + 17)
    pieces = (data[start : start + 65_521] for start in range(0, len(data), 65_521))
    answer = world.client.put(f"/fields/{sha256(data)}", content=pieces)
    assert (answer.status_code, answer.json()["bytes"]) == (201, len(data))
    assert world.blobs.blobs[f"fields/{sha256(data)}/original"] == data


def test_a_ready_field_has_a_picture_if_its_import_made_one(world: World) -> None:
    put(world.client, A)
    assert "preview" not in world.client.get(PLACE).json()["links"]
    assert_refused(world.client.get(f"{PLACE}/preview.png"), 404, "FIELD_VIEW_NOT_FOUND")
    world.records.update_field(sha256(A), attempt=1, state="ready")
    address = world.client.get(f"/v1{PLACE}").json()["links"]["preview"]
    assert address == f"/v1{PLACE}/preview.png"
    assert_refused(world.client.get(address), 404, "FIELD_VIEW_NOT_FOUND")
    world.blobs.put(f"fields/{sha256(A)}/preview.png", b"\x89PNG")
    answer, head = world.client.get(address), world.client.head(address)
    assert (answer.status_code, answer.content, answer.headers["content-type"]) == (200, b"\x89PNG", "image/png")
    assert (head.status_code, head.content, head.headers["etag"]) == (200, b"", answer.headers["etag"])
    world.client.delete(PLACE)
    assert_refused(world.client.get(address), 404, "FIELD_NOT_FOUND")
