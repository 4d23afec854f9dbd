"""POST /batches: lines become jobs a few at a time, and each ends as one result."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any

import httpx
import pytest

from regnf_service.batches.feeder import Feeder
from regnf_service.http.batch_intake import REQUESTS
from regnf_state.batch_records import BatchName
from regnf_state.journal.rebuild import Rebuilder
from regnf_state.ownership import ANONYMOUS
from tests.contract.world import RESULT, World, assert_refused, field_bytes, sha256

NDJSON = {"Content-Type": "application/x-ndjson"}


def pairs(world: World, count: int, **changes: Any) -> list[dict[str, Any]]:
    """So many requests that differ in their seeds."""
    request = world.valid_request()
    return [{**request, "seed": number, "key": f"pair {number}", **changes} for number in range(count)]


def body_of(lines: Iterable[dict[str, Any] | bytes]) -> bytes:
    return b"\n".join(one if isinstance(one, bytes) else json.dumps(one).encode() for one in lines)


def post(world: World, lines: Iterable[dict[str, Any] | bytes]) -> httpx.Response:
    return world.client.post("/batches", content=body_of(lines), headers=NDJSON)


def posted(world: World, lines: Iterable[dict[str, Any] | bytes]) -> str:
    answer = post(world, lines)
    assert answer.status_code == 202, answer.text
    return str(answer.json()["id"])


def results(world: World, batch_id: str, **query: Any) -> list[dict[str, Any]]:
    answer = world.client.get(f"/batches/{batch_id}/results", params=query)
    assert answer.status_code == 200, answer.text
    return [json.loads(line) for line in answer.text.splitlines()]


class Rounds:
    """The feeder's rounds, and a worker's part between them. Time stands still but for a second a round."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.feeder = Feeder(world.app.state.services, REQUESTS)
        self.most_waiting = 0

    def feed(self, rounds: int = 1) -> None:
        for _ in range(rounds):
            self.world.records.ahead_s += 1.0
            self.feeder.run_once()
            self.most_waiting = max(self.most_waiting, len(self.world.queue.registrations))

    def work(self) -> list[str]:
        """Every job that waits succeeds."""
        done = []
        for job_id, _ in self.world.queue.registrations:
            self.world.queue.take(job_id, self.attempt(job_id))
            self.world.succeed(job_id)
            done.append(job_id)
        return done

    def attempt(self, job_id: str) -> int:
        record = self.world.records.get_job(job_id)
        assert record is not None
        return record.attempt

    def until_ended(self, batch_id: str) -> dict[str, Any]:
        for _ in range(500):
            self.feed()
            document: dict[str, Any] = self.world.client.get(f"/batches/{batch_id}").json()
            if document["status"] != "running":
                return document
            self.work()
        raise AssertionError(f"the batch does not end: {document}")


@pytest.fixture
def rounds(world: World) -> Rounds:
    return Rounds(world)


def test_every_pair_becomes_one_result(world: World, rounds: Rounds) -> None:
    batch_id = posted(world, pairs(world, 6))
    document = rounds.until_ended(batch_id)
    assert (document["status"], document["pairs"], document["results"], document["progress"]) == ("finished", 6, 6, 1)
    assert document["counts"] == {"registered": 6, "ambiguous": 0, "rejected": 0, "failed": 0, "refused": 0}
    assert (document["waiting"], document["active"]) == (0, 0)
    found = results(world, batch_id)
    assert [one["number"] for one in found] == list(range(1, 7))
    assert sorted(one["key"] for one in found) == sorted(f"pair {number}" for number in range(6))
    assert len({one["job"] for one in found}) == 6
    assert found[0]["T_object_scene"] == RESULT["T_object_scene"]
    assert (found[0]["status"], found[0]["verdict"]) == ("successful", "registered")
    assert found[0]["metrics"] == {"residual_rms": 0.001, "seconds": 0.0}


def test_a_window_of_jobs_waits_in_the_queue_and_no_more(world: World, rounds: Rounds) -> None:
    posted(world, pairs(world, 30))
    rounds.feed(3)
    assert len(world.queue.registrations) == 2, "two for the one worker"
    single = world.submit(seed=4711)
    assert world.queue.registrations[-1] == (single, 1)
    rounds.work()
    rounds.feed()
    assert 2 <= len(world.queue.registrations) <= 8, "twice as many as have ended at most"


def test_results_come_while_the_batch_runs_and_go_on_after_a_cursor(world: World, rounds: Rounds) -> None:
    batch_id = posted(world, pairs(world, 7))
    seen: list[dict[str, Any]] = []
    for _ in range(100):
        rounds.feed()
        new = results(world, batch_id, after=len(seen), limit=3)
        assert [one["number"] for one in new] == list(range(len(seen) + 1, len(seen) + 1 + len(new)))
        seen += new
        if len(seen) == 7:
            break
        rounds.work()
    assert seen == results(world, batch_id)
    assert [results(world, batch_id, after=after) for after in range(8)] == [seen[after:] for after in range(8)]
    assert world.client.get(f"/batches/{batch_id}/results").headers["batch-status"] == "finished"


def test_bad_lines_refuse_nothing_else(world: World, rounds: Rounds) -> None:
    good = pairs(world, 3)
    lines: list[dict[str, Any] | bytes] = [
        good[0],
        b"{nothing",
        {**good[1], "seed": -1},
        {**good[1], "key": "pair 0"},
        b"",
        b"x" * 70_000,
        good[2],
        {**good[1], "key": 7},
    ]
    answer = post(world, lines).json()
    assert (answer["pairs"], answer["counts"]["refused"]) == (7, 0)
    told = [(one["line"], one["error"]["reason"]) for one in answer["errors"]]
    assert told == [
        (2, "MALFORMED_JSON"),
        (3, "INVALID_REQUEST"),
        (4, "INVALID_REQUEST"),
        (6, "LINE_TOO_LARGE"),
        (8, "INVALID_REQUEST"),
    ]
    document = rounds.until_ended(answer["id"])
    assert (document["counts"]["registered"], document["counts"]["refused"]) == (2, 5)
    refused = results(world, answer["id"], status="refused")
    assert [(one["line"], one["error"]["reason"]) for one in refused] == told
    assert all(one["job"] is None for one in refused)
    assert [one["line"] for one in results(world, answer["id"], status="successful")] == [1, 7]


def test_a_pair_whose_field_is_missing_fails_alone_and_is_repeated(world: World, rounds: Rounds) -> None:
    good = pairs(world, 2)
    late = field_bytes("late")
    lines = [good[0], {**good[1], "object": sha256(late)}]
    batch_id = posted(world, lines)
    document = rounds.until_ended(batch_id)
    assert (document["counts"]["registered"], document["counts"]["failed"]) == (1, 1)
    assert [one["error"]["reason"] for one in results(world, batch_id, status="failed")] == ["FIELD_NOT_FOUND"]
    world.ready_field("late")
    again = post(world, lines)
    assert (again.status_code, again.json()["id"], again.json()["passes"]) == (202, batch_id, 2)
    document = rounds.until_ended(batch_id)
    assert (document["counts"]["registered"], document["counts"]["failed"], document["results"]) == (2, 0, 3)
    assert [one["pair"] for one in results(world, batch_id, after=2)] == [2]
    assert post(world, lines).status_code == 200


def test_a_failed_job_is_its_pairs_result(world: World, rounds: Rounds) -> None:
    batch_id = posted(world, pairs(world, 1))
    rounds.feed()
    ((job_id, attempt),) = world.queue.registrations
    world.queue.take(job_id, attempt)
    world.fail(job_id, reason="NO_SURFACE_IN_DETECTION", detail="no surface")
    rounds.feed(3)
    (line,) = results(world, batch_id)
    assert (line["status"], line["job"], line["error"]["reason"]) == ("failed", job_id, "NO_SURFACE_IN_DETECTION")


def test_a_pair_whose_workers_died_is_started_anew(world: World, rounds: Rounds) -> None:
    batch_id = posted(world, pairs(world, 1))
    for attempt in range(1, 5):
        rounds.feed()
        ((job_id, waiting),) = world.queue.registrations
        assert waiting == attempt
        world.queue.take(job_id, attempt)
        world.fail(job_id, reason="WORKER_LOST", detail="twice")
    rounds.feed(3)
    assert [one["error"]["reason"] for one in results(world, batch_id)] == ["WORKER_LOST"]


def test_equal_pairs_are_one_job(world: World, rounds: Rounds) -> None:
    one = world.valid_request()
    batch_id = posted(world, [{**one, "key": "a"}, {**one, "key": "b"}])
    rounds.feed()
    assert len(world.queue.registrations) == 1
    rounds.until_ended(batch_id)
    first, second = results(world, batch_id)
    assert first["job"] == second["job"]
    assert {first["key"], second["key"]} == {"a", "b"}


def test_a_job_that_was_done_before_is_not_done_again(world: World, rounds: Rounds) -> None:
    job_id = world.submit(seed=0)
    world.queue.take(job_id, 1)
    world.succeed(job_id)
    batch_id = posted(world, pairs(world, 1))
    rounds.feed(2)
    assert world.queue.registrations == []
    assert [one["job"] for one in results(world, batch_id)] == [job_id]


def test_the_same_lines_are_the_same_batch(world: World) -> None:
    lines = pairs(world, 3)
    first = posted(world, lines)
    assert posted(world, [{**one, "options": {"preset": "robust"}} for one in lines]) == first
    assert posted(world, lines[:2]) != first
    assert posted(world, [{**one, "key": None} for one in lines]) != first
    assert len(world.client.get("/batches").json()["batches"]) == 3


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
