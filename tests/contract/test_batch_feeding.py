"""The feeder of batches: a window of jobs, quotas, cancelling, and what it survives."""

from __future__ import annotations

from typing import Any

from regnf_state.batch_records import BatchName
from regnf_state.journal.rebuild import Rebuilder
from regnf_state.ownership import ANONYMOUS
from tests.contract.batch_rounds import Rounds, pairs, posted, results
from tests.contract.world import World


def test_a_window_of_jobs_waits_in_the_queue_and_no_more(world: World, rounds: Rounds) -> None:
    posted(world, pairs(world, 30))
    rounds.feed(3)
    assert len(world.queue.registrations) == 2, "two for the one worker"
    single = world.submit(seed=4711)
    assert world.queue.registrations[-1] == (single, 1)
    rounds.work()
    rounds.feed()
    assert 2 <= len(world.queue.registrations) <= 8, "twice as many as have ended at most"


def test_cancelling_stops_the_jobs_that_it_started(world: World, rounds: Rounds) -> None:
    batch_id = posted(world, pairs(world, 10))
    rounds.feed()
    jobs = [job_id for job_id, _ in world.queue.registrations]
    answer = world.client.post(f"/batches/{batch_id}/cancel")
    assert (answer.status_code, answer.json()["status"], answer.json()["active"]) == (202, "dismissed", 0)
    assert world.queue.registrations == []
    assert {world.records.get_job(job_id).status for job_id in jobs} == {"dismissed"}  # type: ignore[union-attr]
    rounds.feed(2)
    assert world.queue.registrations == []
    assert world.client.post(f"/batches/{batch_id}/cancel").status_code == 200


def test_a_cancelled_batch_goes_on_when_it_is_posted_again(world: World, rounds: Rounds) -> None:
    lines = pairs(world, 10)
    batch_id = posted(world, lines)
    rounds.feed()
    done = rounds.work()
    rounds.feed(2)
    world.client.post(f"/batches/{batch_id}/cancel")
    assert posted(world, lines) == batch_id
    document = rounds.until_ended(batch_id)
    assert document["counts"]["registered"] == document["results"] == 10
    attempts = {one["job"]: rounds.attempt(one["job"]) for one in results(world, batch_id)}
    assert all(attempts[job_id] == 1 for job_id in done), "what was done is not done again"


def test_cancelling_leaves_jobs_that_others_asked_for(world: World, rounds: Rounds) -> None:
    lines = pairs(world, 2)
    single = world.submit(seed=0)
    batch_id = posted(world, lines)
    rounds.feed()
    assert len(world.queue.registrations) == 2
    world.client.post(f"/batches/{batch_id}/cancel")
    assert world.queue.registrations == [(single, 1)]


def test_a_quota_holds_a_batch_back_and_loses_nothing(worlds: Any) -> None:
    world = worlds(quota_active_jobs=1)
    rounds = Rounds(world)
    batch_id = posted(world, pairs(world, 5))
    rounds.feed()
    document = world.client.get(f"/batches/{batch_id}").json()
    assert (document["waits_for"], document["active"], document["waiting"]) == ("QUOTA_ACTIVE_JOBS", 1, 4)
    document = rounds.until_ended(batch_id)
    assert (document["counts"]["registered"], document["waits_for"]) == (5, None)


def test_a_lost_redis_loses_no_pair(world: World, rounds: Rounds) -> None:
    lines = pairs(world, 8)
    for name in ("scene", "object"):
        world.blobs.put(f"fields/{lines[0][name]}/field.safetensors", b"")  # without it the journal forgets the field
    batch_id = posted(world, lines)
    rounds.feed()
    rounds.work()
    rounds.feed(2)
    before = results(world, batch_id)
    assert before
    world.redis.flushall()
    assert results(world, batch_id) == before
    assert [one["id"] for one in world.client.get("/batches").json()["batches"]] == [batch_id]
    Rebuilder(world.records, world.queue, world.blobs).run_if_needed()  # as the reaper does: it queues the jobs again
    document = rounds.until_ended(batch_id)
    found = results(world, batch_id)
    assert (document["counts"]["registered"], len(found), len({one["pair"] for one in found})) == (8, 8, 8)


def test_two_feeders_write_each_result_once(world: World, rounds: Rounds) -> None:
    batch_id = posted(world, pairs(world, 9))
    other = Rounds(world)
    for _ in range(40):
        rounds.feed()
        other.feed()
        rounds.work()
    found = results(world, batch_id)
    assert sorted(one["pair"] for one in found) == list(range(1, 10))


def test_a_feeder_that_was_overtaken_changes_nothing(world: World, rounds: Rounds) -> None:
    """It looked at the batch, was stopped for long, and goes on when another process has cancelled it."""
    batch_id = posted(world, pairs(world, 4))
    batches = world.app.state.services.batches
    known = batches.index.state(BatchName(ANONYMOUS, batch_id))
    world.client.post(f"/batches/{batch_id}/cancel")
    assert not batches.index.note(BatchName(ANONYMOUS, batch_id), known)
    assert world.client.get(f"/batches/{batch_id}").json()["status"] == "dismissed"


def test_batches_of_a_caller_share_its_places(world: World, rounds: Rounds) -> None:
    world.queue.workers = 2
    first, second = posted(world, pairs(world, 12)), posted(world, pairs(world, 5, options={"up_axis": "z"}))
    rounds.feed()
    active = [world.client.get(f"/batches/{one}").json()["active"] for one in (first, second)]
    assert active == [2, 2]
