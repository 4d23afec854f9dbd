"""Records of other releases and damaged ones, over HTTP: no 500, no list without the others, no round that ends."""

from __future__ import annotations

from typing import Any

import pytest

from regnf_service.upkeep.housekeeping import Housekeeper
from regnf_service.upkeep.reaper import Reaper
from tests.contract.world import NOBODY, World, assert_refused

DAMAGES: dict[str, dict[str, Any]] = {
    "damaged": {"document": "{"},
    "of an unknown status": {"document": '{"status": "paused"}'},
    "of a later format": {"format": "99"},
}


def without_journal(world: World) -> None:
    world.blobs.delete_prefix("journal/jobs")
    world.blobs.delete_prefix("journal/fields")


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_a_job_that_cannot_be_read_has_a_reason_and_lists_go_on(world: World, damage: dict[str, Any]) -> None:
    bad, good = world.submit(), world.submit(seed=1)
    without_journal(world)
    world.redis.hset(f"regnf:job:{bad}", mapping=damage)
    for address in (f"/jobs/{bad}", f"/jobs/{bad}/result", f"/jobs/{bad}/events", f"/jobs/{bad}/view"):
        answer = world.client.get(address)
        assert_refused(answer, 503, "RECORD_UNREADABLE")
        assert "retry-after" in answer.headers
    assert_refused(world.client.post(f"/jobs/{bad}/cancel"), 503, "RECORD_UNREADABLE")
    assert_refused(world.client.get(f"/jobs/{NOBODY}"), 404, "JOB_NOT_FOUND")
    assert [job["id"] for job in world.client.get("/jobs").json()["jobs"]] == [good]


def test_a_damaged_job_is_made_anew_from_the_journal_or_asked_for_anew(world: World) -> None:
    job_id = world.submit()
    document: bytes = world.redis.hget(f"regnf:job:{job_id}", "document")  # type: ignore[assignment]
    for damaged in (b"{", document[:-1] + b', "budget": 3}'):  # a member that no record has
        world.redis.hset(f"regnf:job:{job_id}", "document", damaged)
        assert world.client.get(f"/jobs/{job_id}").json()["status"] == "accepted"
    without_journal(world)
    world.redis.hset(f"regnf:job:{job_id}", "document", "{")
    assert_refused(world.client.get(f"/jobs/{job_id}"), 503, "RECORD_UNREADABLE")
    assert world.submit() == job_id
    assert world.client.get(f"/jobs/{job_id}").json()["status"] == "accepted"


def test_a_damaged_field_has_a_reason_and_may_be_sent_again(world: World) -> None:
    sha256 = world.ready_field("scene")
    request = world.valid_request()
    without_journal(world)
    world.redis.hset(f"regnf:field:{sha256}", "document", "{")
    assert_refused(world.client.get(f"/fields/{sha256}"), 503, "RECORD_UNREADABLE")
    assert_refused(world.client.post("/register", json=request), 404, "FIELD_NOT_FOUND")
    assert len(world.client.get("/fields").json()["fields"]) == 1
    assert world.ready_field("scene") == sha256
    assert world.client.get(f"/fields/{sha256}").json()["state"] == "ready"


@pytest.mark.parametrize("text", ["{", "[]", '{"format": 7}'])
def test_a_manifest_that_cannot_be_read_has_a_reason(world: World, text: str) -> None:
    job_id = world.submit()
    world.succeed(job_id)
    world.blobs.put(f"jobs/{job_id}/manifest.json", text.encode())
    assert_refused(world.client.get(f"/jobs/{job_id}/result"), 503, "RECORD_UNREADABLE")


def test_a_round_of_the_reaper_goes_on_past_it(world: World) -> None:
    """Fails a lost job, expires, and keeps house, with a record before each that cannot be read."""
    bad, lost = world.submit(), world.submit(seed=1)
    without_journal(world)
    for job_id in (bad, lost):
        world.run(job_id)
        world.queue.take(job_id, 1)
    world.redis.hset(f"regnf:job:{bad}", "format", "2")
    now = [0.0]
    housekeeper = Housekeeper(world.records, world.blobs, world.redis, world.settings)
    reaper = Reaper(
        world.records, world.queue, world.redis, world.settings, world.blobs, None, housekeeper, lambda: now[0]
    )
    while now[0] < 120:
        reaper.run_once()
        now[0] += 15
    assert [one.id for one in world.records.active_jobs()] == [lost]
    assert world.records.get_job(lost).attempt == 2  # type: ignore[union-attr]
    assert world.redis.hget(f"regnf:job:{bad}", "format") == b"2"


def test_a_damaged_idempotency_entry_is_none(world: World) -> None:
    request, key = world.valid_request(), {"Idempotency-Key": "k"}
    job_id = world.client.post("/register", json=request, headers=key).json()["id"]
    (entry,) = world.redis.keys("regnf:once:idempotency:*")
    world.redis.set(entry, "nonsense")
    assert world.client.post("/register", json=request, headers=key).json()["id"] == job_id
