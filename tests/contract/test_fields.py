"""Fields over HTTP: upload, look, list, delete."""

from __future__ import annotations

import base64
import hashlib
import json
from pathlib import Path
from typing import Any

import httpx
import pytest
from redis import Redis

from tests.contract.world import World, assert_refused, field_bytes, make_world, sha256

A, B = field_bytes("a"), field_bytes("b")


def content_digest(data: bytes) -> str:
    return f"sha-256=:{base64.b64encode(hashlib.sha256(data).digest()).decode()}:"


def test_put_stores_the_bytes_and_queues_their_import(world: World) -> None:
    answer = world.client.put(f"/fields/{sha256(A)}", content=A, headers={"Content-Digest": content_digest(A)})
    assert answer.status_code == 201
    assert answer.headers["location"] == f"/fields/{sha256(A)}"
    document = answer.json()
    assert (document["state"], document["bytes"], document["sha256"]) == ("validating", len(A), sha256(A))
    assert world.blobs.blobs == {f"fields/{sha256(A)}/original": A}
    assert world.queue.imports == [(sha256(A), 1)]


def test_an_import_that_waits_says_how_many_are_before_it(world: World) -> None:
    for name in ("a", "b"):
        data = field_bytes(name)
        world.client.put(f"/fields/{sha256(data)}", content=data)
    assert world.client.get(f"/fields/{sha256(B)}").json()["queue_position"] == 2
    listed = world.client.get("/fields", headers={"Accept": "application/json"}).json()["fields"]
    assert [one["queue_position"] for one in listed] == [None, None]


def test_the_same_upload_twice_is_one_field(world: World) -> None:
    assert [world.client.put(f"/fields/{sha256(A)}", content=A).status_code for _ in range(2)] == [201, 200]
    assert world.queue.imports == [(sha256(A), 1)]


def test_an_upload_that_was_never_queued_is_queued_by_the_next(world: World) -> None:
    world.client.put(f"/fields/{sha256(A)}", content=A)
    world.queue.lose()
    world.client.put(f"/fields/{sha256(A)}", content=A)
    assert world.queue.imports == [(sha256(A), 1)]


def test_bytes_that_are_held_safely_are_not_kept_again(world: World) -> None:
    known = world.ready_field("a")
    assert world.client.put(f"/fields/{known}", content=field_bytes("a")).status_code == 200
    assert world.blobs.blobs == {}


def test_a_rejected_field_can_be_uploaded_again(world: World) -> None:
    known = world.rejected_field("a")
    assert world.client.get(f"/fields/{known}").json()["error"]["reason"] == "FIELD_SHAPES_MISMATCH"
    answer = world.client.put(f"/fields/{known}", content=A)
    assert answer.status_code == 201
    assert (answer.json()["state"], answer.json()["error"]) == ("validating", None)
    assert world.queue.imports[-1] == (known, 2)
    assert f"fields/{known}/original" in world.blobs.blobs


def test_post_computes_the_digest(world: World) -> None:
    answer = world.client.post("/fields", content=A)
    assert (answer.status_code, answer.headers["location"]) == (201, f"/fields/{sha256(A)}")


def test_post_takes_a_description_beside_the_file(world: World) -> None:
    said = {"family": "neus-facto", "level_mask": 8, "hash": {"features_per_level": 2}, "label": "room"}
    files: dict[str, Any] = {"file": ("room.ckpt", A), "description": (None, json.dumps(said), "application/json")}
    answer = world.client.post("/fields", files=files)
    assert answer.status_code == 201, answer.text
    assert (answer.json()["label"], answer.json()["description"]) == (
        "room",
        {"family": "neus-facto", "level_mask": 8, "hash": {"features_per_level": 2}},
    )
    assert world.blobs.blobs == {f"fields/{sha256(A)}/original": A}


def test_bytes_held_as_another_function_are_not_silently_that_one(world: World) -> None:
    def post(said: dict[str, object]) -> httpx.Response:
        return world.client.post("/fields", files={"file": ("a", A), "description": (None, json.dumps(said))})

    assert post({"level_mask": 8}).status_code == 201
    assert post({"level_mask": 8, "label": "named later"}).json()["label"] == "named later"
    assert_refused(post({"level_mask": 4}), 409, "FIELD_DESCRIPTION_DIFFERS")
    assert world.client.put(f"/fields/{sha256(A)}", content=A).status_code == 200


def test_get_and_head_tell_what_is_held(world: World) -> None:
    known = world.ready_field("a")
    document = world.client.get(f"/fields/{known}").json()
    assert (document["state"], document["report"]["bounds"][0]) == ("ready", [-1.0, -1.0, -1.0])
    assert world.client.head(f"/fields/{sha256(B)}").status_code == 404


@pytest.mark.parametrize("state", ["validating", "ready", "rejected"])
def test_head_is_get_without_content(world: World, state: str) -> None:
    path = f"/fields/{sha256(A)}"
    world.client.put(path, content=A)
    if state != "validating":
        world.records.update_field(sha256(A), attempt=1, state=state)
    get, head = world.client.get(path), world.client.head(path)
    assert (head.status_code, head.content) == (get.status_code, b"") == (200, b"")
    own = {"x-request-id", "date"}
    assert {name: value for name, value in head.headers.items() if name not in own} == {
        name: value for name, value in get.headers.items() if name not in own
    }
    assert ("retry-after" in head.headers) == (state == "validating")
    assert get.json()["state"] == state


def test_get_may_wait_for_the_import(world: World) -> None:
    world.client.put(f"/fields/{sha256(A)}", content=A)
    waited = world.client.get(f"/fields/{sha256(A)}", params={"wait": 1})
    assert (waited.json()["state"], waited.headers["retry-after"]) == ("validating", "1")


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
    pages = [world.client.get("/fields", params={"label": "chair", "limit": 1}).json()]
    while (token := pages[-1]["next_page_token"]) is not None:
        params = {"label": "chair", "limit": 1, "page_token": token}
        pages.append(world.client.get("/fields", params=params).json())
    assert pages[0]["fields"] == []
    assert [field["sha256"] for page in pages for field in page["fields"]] == [known[0]]
    world.submit(seed=1)
    page = world.client.get("/jobs", params={"status": "failed", "limit": 1}).json()
    assert (page["jobs"], page["next_page_token"] is not None) == ([], True)


def test_delete_leaves_nothing(world: World) -> None:
    world.client.put(f"/fields/{sha256(A)}", content=A)
    assert world.client.delete(f"/fields/{sha256(A)}").status_code == 204
    assert world.blobs.blobs == {}
    assert_refused(world.client.get(f"/fields/{sha256(A)}"), 404, "FIELD_NOT_FOUND")
    assert_refused(world.client.delete(f"/fields/{sha256(A)}"), 404, "FIELD_NOT_FOUND")


def test_a_field_that_is_deleted_before_its_import_leaves_nothing_in_the_queue(world: World) -> None:
    for _ in range(3):
        assert world.client.put(f"/fields/{sha256(A)}", content=A).status_code == 201
        assert len(world.queue.waiting) == 1
        assert world.client.delete(f"/fields/{sha256(A)}").status_code == 204
        assert world.queue.waiting == []


def test_a_field_that_a_job_needs_is_not_deleted(world: World) -> None:
    job_id = world.submit()
    scene = world.valid_request()["scene"]
    assert_refused(world.client.delete(f"/fields/{scene}"), 409, "FIELD_IN_USE")
    world.succeed(job_id)
    assert world.client.delete(f"/fields/{scene}").status_code == 204


def test_v1_is_the_same_service(world: World) -> None:
    answer = world.client.put(f"/v1/fields/{sha256(A)}", content=A)
    assert answer.headers["location"] == f"/v1/fields/{sha256(A)}"
    assert world.client.get(f"/fields/{sha256(A)}").json()["links"]["self"] == f"/fields/{sha256(A)}"


def test_uploads_far_larger_than_a_block_arrive_whole(tmp_path: Path, any_redis: Redis) -> None:
    world = make_world(tmp_path, any_redis, max_upload_bytes=8 << 20)
    data = field_bytes("large", 3 * (1 << 20) + 17)
    pieces = (data[start : start + 65_521] for start in range(0, len(data), 65_521))
    answer = world.client.put(f"/fields/{sha256(data)}", content=pieces)
    assert (answer.status_code, answer.json()["bytes"]) == (201, len(data))
    assert world.blobs.blobs[f"fields/{sha256(data)}/original"] == data


def test_a_ready_field_has_a_picture_if_its_import_made_one(world: World) -> None:
    known = world.ready_field("a")
    address = world.client.get(f"/v1/fields/{known}").json()["links"]["preview"]
    assert address == f"/v1/fields/{known}/preview.png"
    assert_refused(world.client.get(address), 404, "FIELD_VIEW_NOT_FOUND")
    world.blobs.put(f"fields/{known}/preview.png", b"\x89PNG")
    answer = world.client.get(address)
    assert (answer.status_code, answer.content, answer.headers["content-type"]) == (200, b"\x89PNG", "image/png")
    head = world.client.head(address)
    assert (head.status_code, head.content, head.headers["etag"]) == (200, b"", answer.headers["etag"])
    world.client.delete(f"/fields/{known}")
    assert_refused(world.client.get(address), 404, "FIELD_NOT_FOUND")


def test_a_field_that_is_not_ready_has_no_picture(world: World) -> None:
    world.client.put(f"/fields/{sha256(A)}", content=A)
    assert "preview" not in world.client.get(f"/fields/{sha256(A)}").json()["links"]
    assert_refused(world.client.get(f"/fields/{sha256(A)}/preview.png"), 404, "FIELD_VIEW_NOT_FOUND")
