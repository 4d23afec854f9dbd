"""What is no batch, how many a caller has, and when batches go."""

from __future__ import annotations

from typing import Any

import pytest

from tests.contract.batch_rounds import NDJSON, Rounds, pairs, post, posted, results
from tests.contract.world import World, assert_refused


@pytest.mark.parametrize(
    ("content", "headers", "status", "reason"),
    [
        (b"", NDJSON, 422, "BATCH_EMPTY"),
        (b"\n \n", NDJSON, 422, "BATCH_EMPTY"),
        (b"{}", {"Content-Type": "application/json"}, 415, "UNSUPPORTED_MEDIA_TYPE"),
        (b"{}", NDJSON | {"Content-Encoding": "gzip"}, 415, "UNSUPPORTED_MEDIA_TYPE"),
        (b"{}\n" * 6, NDJSON, 413, "TOO_MANY_PAIRS"),
        (b" " * 3000, NDJSON, 413, "REQUEST_TOO_LARGE"),
    ],
)
def test_what_is_no_batch(worlds: Any, content: bytes, headers: dict[str, str], status: int, reason: str) -> None:
    world = worlds(max_batch_pairs=5, max_batch_bytes=2048)
    assert_refused(world.client.post("/batches", content=content, headers=headers), status, reason)
    assert world.blobs.blobs == {}


def test_a_caller_has_so_many_batches_and_the_oldest_that_has_ended_goes(worlds: Any) -> None:
    world = worlds(quota_batches=2)
    rounds = Rounds(world)
    lines = pairs(world, 3)
    first, second = posted(world, lines[:1]), posted(world, lines[1:2])
    assert_refused(post(world, lines[2:]), 429, "QUOTA_BATCHES")
    rounds.until_ended(first)
    third = posted(world, lines[2:])
    left = {one["id"] for one in world.client.get("/batches").json()["batches"]}
    assert third in left
    (gone,) = {first, second} - left
    assert_refused(world.client.get(f"/batches/{gone}"), 410, "BATCH_EXPIRED")


def test_an_unknown_batch(world: World) -> None:
    for batch_id in ("0" * 32, "nothing", "A" * 32):
        assert_refused(world.client.get(f"/batches/{batch_id}"), 404, "BATCH_NOT_FOUND")


def test_only_a_batch_that_has_ended_is_deleted(world: World, rounds: Rounds) -> None:
    batch_id = posted(world, pairs(world, 1))
    assert_refused(world.client.delete(f"/batches/{batch_id}"), 409, "BATCH_ACTIVE")
    rounds.until_ended(batch_id)
    assert_refused(world.client.post(f"/batches/{batch_id}/cancel"), 409, "BATCH_FINISHED")
    (line,) = results(world, batch_id)
    assert world.client.delete(f"/batches/{batch_id}").status_code == 204
    assert_refused(world.client.get(f"/batches/{batch_id}"), 404, "BATCH_NOT_FOUND")
    assert world.client.get(f"/jobs/{line['job']}").status_code == 200
    assert not [key for key in world.blobs.blobs if key.startswith("batches/")]


def test_a_batch_expires(world: World, rounds: Rounds) -> None:
    batch_id = posted(world, pairs(world, 1))
    rounds.until_ended(batch_id)
    assert rounds.feeder.expire() == []
    world.records.ahead_s += world.settings.retention_s + 1
    assert rounds.feeder.expire() == [batch_id]
    assert_refused(world.client.get(f"/batches/{batch_id}"), 410, "BATCH_EXPIRED")


def test_lists_are_paged(world: World) -> None:
    ids = [posted(world, [one]) for one in pairs(world, 3)]
    page = world.client.get("/batches?limit=2").json()
    rest = world.client.get("/batches", params={"limit": 2, "page_token": page["next_page_token"]}).json()
    assert [one["id"] for one in page["batches"] + rest["batches"]] == ids[::-1]
    assert rest["next_page_token"] is None
