"""POST /batches: lines become jobs a few at a time, and each ends as one result."""

from __future__ import annotations

from typing import Any

from tests.contract.batch_rounds import Rounds, pairs, post, posted, results
from tests.contract.world import RESULT, World, field_bytes, sha256


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
