"""POST /batches: lines become jobs at once, and the jobs tell how far the batch is."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from typing import Any

import pytest

from regnf_service.upkeep.reaper import Reaper
from regnf_state.blobs.local import LocalBlobWriter
from regnf_state.journal.journaled_records import Rebuilder
from regnf_state.ownership import reference_of
from regnf_state.queue import QUEUE_NAME, Work
from regnf_state.reasons import problem_document
from tests.contract.asgi import client_of
from tests.contract.batch_posts import NDJSON, body_of, document, pairs, post, posted, results, work
from tests.contract.world import BOX, RESULT, TOKENS, World, assert_refused, field_bytes, sha256
from tests.round_trips import counted_round_trips

# from lines to results


def test_every_pair_becomes_one_job_and_one_result(world: World) -> None:
    batch_id = posted(world, pairs(world, 6))
    told = document(world, batch_id)
    assert (told["status"], told["pairs"], told["active"], told["progress"]) == ("running", 6, 6, 0)
    assert len(work(world)) == 6
    told = document(world, batch_id)
    assert (told["status"], told["active"], told["progress"]) == ("finished", 0, 1)
    assert told["counts"] == {"registered": 6, "ambiguous": 0, "rejected": 0, "failed": 0, "refused": 0}
    found = results(world, batch_id)
    assert [one["number"] for one in found] == list(range(1, 7))
    assert [one["key"] for one in found] == [f"pair {number}" for number in range(6)]
    assert len({one["job"] for one in found}) == 6
    assert found[0]["T_object_scene"] == RESULT["T_object_scene"]
    assert [found[0][told] for told in ("status", "verdict", "level")] == ["successful", "registered", "default"]
    assert found[0]["metrics"] == {"residual_rms": 0.001, "seconds": 0.0}


def test_results_come_in_order_up_to_the_first_pair_that_has_not_ended(world: World) -> None:
    batch_id = posted(world, pairs(world, 7))
    jobs = [job_id for job_id, _ in world.queue.registrations]
    for job_id in jobs[:2] + jobs[3:4]:
        world.queue.take(job_id, 1)
        world.succeed(job_id)
    answer = world.client.get(f"/batches/{batch_id}/results")
    assert [json.loads(line)["job"] for line in answer.text.splitlines()] == jobs[:2]
    assert (answer.headers["batch-after"], answer.headers["batch-left"]) == ("2", "5")
    assert results(world, batch_id, after=2, wait=1) == []
    assert document(world, batch_id)["active"] == 4
    work(world)
    seen: list[dict[str, Any]] = []
    while len(seen) < 7:
        seen += results(world, batch_id, after=len(seen), limit=3)
    assert seen == results(world, batch_id)
    assert [results(world, batch_id, after=after) for after in range(8)] == [seen[after:] for after in range(8)]
    assert world.client.get(f"/batches/{batch_id}/results").headers["batch-left"] == "0"


def test_bad_lines_refuse_nothing_else(world: World) -> None:
    first, second, third = pairs(world, 3)
    far = {"min": [50, 50, 50], "max": [51, 51, 51]}
    lines: list[dict[str, Any] | bytes] = [
        first, b"{nothing", {**second, "seed": -1}, {**second, "key": "pair 0"}, b"", b"x" * 70_000, third,
        {**second, "key": 7}, {**second, "object": {"library": "nothing"}}, {**second, "key": "far", "detection": far},
    ]  # fmt: skip
    answer = post(world, lines).json()
    assert (answer["pairs"], answer["active"], answer["counts"]["refused"]) == (9, 2, 7)
    told = {one["line"]: one["error"]["reason"] for one in answer["errors"]}
    assert told == {
        2: "MALFORMED_JSON", 3: "INVALID_REQUEST", 4: "INVALID_REQUEST", 6: "REQUEST_TOO_LARGE", 8: "INVALID_REQUEST",
        9: "LIBRARY_ENTRY_NOT_FOUND", 10: "DETECTION_OUTSIDE_SCENE",
    }  # fmt: skip
    work(world)
    assert document(world, answer["id"])["counts"]["registered"] == 2
    refused = results(world, answer["id"], status="refused")
    assert {one["line"]: one["error"]["reason"] for one in refused} == told
    assert all(one["job"] is None for one in refused)
    assert [one["line"] for one in results(world, answer["id"], status="successful")] == [1, 7]
    assert results(world, answer["id"], status="failed") == []


def test_a_line_whose_field_is_missing_becomes_a_job_once_it_is_there(world: World) -> None:
    good = pairs(world, 2)
    lines = [good[0], {**good[1], "object": sha256(field_bytes("late"))}]
    batch_id = posted(world, lines)
    work(world)
    assert [one["error"]["reason"] for one in results(world, batch_id, status="refused")] == ["FIELD_NOT_FOUND"]
    world.ready_field("late")
    again = post(world, lines)
    assert (again.status_code, again.json()["id"], again.json()["active"]) == (202, batch_id, 1)
    assert len(work(world)) == 1, "the first is not done again"
    assert document(world, batch_id)["counts"]["registered"] == 2
    assert post(world, lines).status_code == 200


def test_a_failed_job_is_its_pairs_result_and_starts_anew_when_the_lines_are_posted_again(world: World) -> None:
    lines = pairs(world, 1)
    batch_id = posted(world, lines)
    ((job_id, attempt),) = world.queue.registrations
    world.queue.take(job_id, attempt)
    world.fail(job_id, **problem_document("NO_SURFACE_IN_DETECTION"))
    (line,) = results(world, batch_id)
    assert (line["status"], line["job"], line["error"]["reason"]) == ("failed", job_id, "NO_SURFACE_IN_DETECTION")
    assert posted(world, lines) == batch_id
    assert world.queue.registrations == [(job_id, 2)]


def test_equal_pairs_are_one_job_and_what_was_done_before_is_not_done_again(world: World) -> None:
    one = world.valid_request()
    batch_id = posted(world, [{**one, "key": "a"}, {**one, "key": "b"}])
    (job_id,) = work(world)
    assert [(line["job"], line["key"]) for line in results(world, batch_id)] == [(job_id, "a"), (job_id, "b")]
    answer = post(world, pairs(world, 1))
    assert (answer.status_code, world.queue.registrations) == (200, [])
    assert [line["job"] for line in results(world, answer.json()["id"])] == [job_id]


def test_a_pair_whose_job_is_gone_says_so(world: World) -> None:
    lines = pairs(world, 3)
    batch_id = posted(world, lines)
    work(world)
    jobs = [one["job"] for one in results(world, batch_id)]
    assert world.client.delete(f"/jobs/{jobs[0]}").status_code == 204
    world.redis.hset(f"regnf:job:{jobs[1]}", "document", "{")
    world.records.journal.forget(jobs[1])
    told = [one.get("error", {}).get("reason") for one in results(world, batch_id)]
    assert told == ["JOB_EXPIRED", "RECORD_UNREADABLE", None]
    assert document(world, batch_id)["counts"]["failed"] == 2
    assert posted(world, lines) == batch_id
    assert len(work(world)) == 2


def test_the_same_lines_are_the_same_batch(world: World) -> None:
    lines = pairs(world, 3)
    first = posted(world, lines)
    assert posted(world, [{**one, "options": {"preset": "robust"}} for one in lines]) == first
    assert posted(world, lines[:2]) != first
    assert posted(world, [{**one, "key": None} for one in lines]) != first
    assert len(world.client.get("/batches").json()["batches"]) == 3
    assert len(work(world)) == 3


# limits


def test_what_is_no_batch(worlds: Any) -> None:
    world = worlds(max_batch_pairs=5, max_batch_bytes=2048)
    cases: list[tuple[bytes, dict[str, str], int, str]] = [
        (b"", NDJSON, 422, "INVALID_REQUEST"),
        (b"\n \n", NDJSON, 422, "INVALID_REQUEST"),
        (b"{}", {"Content-Type": "application/json"}, 415, "UNSUPPORTED_MEDIA_TYPE"),
        (b"{}", NDJSON | {"Content-Encoding": "gzip"}, 415, "UNSUPPORTED_MEDIA_TYPE"),
        (b"{}\n" * 6, NDJSON, 413, "REQUEST_TOO_LARGE"),
        (b" " * 3000, NDJSON, 413, "REQUEST_TOO_LARGE"),
        (b"\xff\xfe{\x00\n", NDJSON, 400, "MALFORMED_JSON"),
        ('{"a": 1}\n'.encode("utf-16-le")[:-1] + b"\x00\xd8", NDJSON, 400, "MALFORMED_JSON"),
    ]
    for content, headers, status, reason in cases:
        assert_refused(world.client.post("/batches", content=content, headers=headers), status, reason)
    assert world.blobs.blobs == {}
    assert world.client.get("/batches").json()["batches"] == []


@pytest.mark.parametrize(
    ("settings", "free", "reason", "status"),
    [
        ({"quota_active_jobs": 4}, 3, "QUOTA_ACTIVE_JOBS", 429),
        ({"max_queued_jobs": 4}, 3, "QUEUE_FULL", 503),
        ({"max_queued_jobs": 9, "quota_active_jobs": 6}, 5, "QUOTA_ACTIVE_JOBS", 429),
    ],
)
def test_a_batch_that_does_not_fit_starts_nothing(
    worlds: Any, settings: dict[str, int], free: int, reason: str, status: int
) -> None:
    """Equal pairs and jobs that exist take no room."""
    world = worlds(**settings)
    known, *new = pairs(world, 9)
    world.submit(seed=0)
    lines = [known, new[0], {**new[0], "key": "again"}, *new[1:]]
    answer = post(world, lines)
    assert_refused(answer, status, reason)
    assert int(answer.headers["Retry-After"]) >= 1
    assert (answer.json()["new_jobs"], answer.json()["fitting_lines"]) == (8, free + 2)
    assert len(world.queue.registrations) == 1
    assert world.client.get("/batches").json()["batches"] == []
    batch_id = posted(world, lines[: free + 2])
    assert document(world, batch_id)["active"] == free + 2
    assert_refused(post(world, lines), status, reason)
    work(world)


def test_a_caller_has_a_share_of_the_queue(worlds: Callable[..., World]) -> None:
    world = worlds(api_tokens=TOKENS, max_queued_jobs=12)
    with client_of(world.app, headers={"Authorization": "Bearer the-secret-of-alice"}) as alice:
        world.client = alice
        request = {"scene": sha256(b"s"), "object": sha256(b"o"), "detection": BOX}
        for name in ("s", "o"):
            alice.put(f"/fields/{sha256(field_bytes(name))}", content=field_bytes(name))
            request |= {{"s": "scene", "o": "object"}[name]: sha256(field_bytes(name))}
        lines = [{**request, "seed": seed} for seed in range(9)]
        answer = post(world, lines)
        assert_refused(answer, 429, "QUOTA_ACTIVE_JOBS")
        assert answer.json()["fitting_lines"] == 6
        assert post(world, lines[:6]).status_code == 202
        assert post(world, lines[:7]).json()["fitting_lines"] == 6


def test_batches_count_among_the_bytes_of_their_caller(worlds: Callable[..., World]) -> None:
    world = worlds(quota_stored_bytes=1700)
    long = [{**one, "key": str(one["seed"]) * 190} for one in pairs(world, 2)]
    assert_refused(post(world, long), 403, "QUOTA_STORED")
    assert world.queue.registrations == []
    posted(world, long[:1])
    data = field_bytes("another", 500)
    assert_refused(world.client.put(f"/fields/{sha256(data)}", content=data), 403, "QUOTA_STORED")


def test_a_caller_has_so_many_batches_and_the_oldest_that_has_ended_goes(worlds: Any) -> None:
    world = worlds(quota_batches=2)
    lines = pairs(world, 4)
    first, second = posted(world, lines[:1]), posted(world, lines[1:2])
    assert_refused(post(world, lines[2:]), 429, "QUOTA_ACTIVE_JOBS")
    assert len(world.queue.registrations) == 2, "nothing was started"
    assert posted(world, lines[:1]) == first, "it has it already"
    ((job_id, _),) = [one for one in world.queue.registrations if world.records.get_job(one[0]).inputs["seed"] == 1]
    world.queue.take(job_id, 1)
    world.succeed(job_id)
    third = posted(world, lines[2:])
    assert {one["id"] for one in world.client.get("/batches").json()["batches"]} == {first, third}
    assert_refused(world.client.get(f"/batches/{second}"), 404, "BATCH_NOT_FOUND")


def test_what_is_kept_and_told_of_problems_is_bounded(world: World) -> None:
    bad = {"scene": 1, "object": 2, "detection": {"x" * 200: 1}, **{f"unknown-{n}-" + "y" * 150: n for n in range(60)}}
    answer = post(world, [{**bad, "seed": -seed} for seed in range(600)])
    assert answer.status_code == 200, answer.text
    batch_id = answer.json()["id"]
    (stored,) = [len(data) for key, data in world.blobs.blobs.items() if key.endswith(batch_id)]
    assert stored < 700_000
    assert len(world.client.get(f"/batches/{batch_id}").content) < 100_000
    assert len(world.client.get("/batches").content) < 1000
    page = world.client.get(f"/batches/{batch_id}/results")
    assert len(page.content) < 1_200_000
    assert int(page.headers["batch-left"]) > 0, "a page looks at some hundreds of pairs"


# stopping and forgetting


def test_cancelling_stops_the_jobs_that_it_started(world: World) -> None:
    single = world.submit(seed=0)
    lines = pairs(world, 10)
    batch_id = posted(world, lines)
    done = work(world, 3)
    answer = world.client.post(f"/batches/{batch_id}/cancel")
    assert (answer.status_code, answer.json()["status"], answer.json()["counts"]["failed"]) == (202, "dismissed", 7)
    assert world.queue.registrations == []
    assert single in done
    assert world.client.post(f"/batches/{batch_id}/cancel").status_code == 200
    assert {one["error"]["reason"] for one in results(world, batch_id, status="failed")} == {"JOB_DISMISSED"}
    assert posted(world, lines) == batch_id
    assert len(work(world)) == 7, "what was done is not done again"
    assert document(world, batch_id)["counts"]["registered"] == 10


def test_cancelling_and_deleting_leave_jobs_that_others_asked_for(world: World) -> None:
    single = world.submit(seed=0)
    batch_id = posted(world, pairs(world, 2))
    world.client.post(f"/batches/{batch_id}/cancel")
    assert world.queue.registrations == [(single, 1)]
    assert document(world, batch_id)["status"] == "running"
    assert world.client.delete(f"/batches/{batch_id}").status_code == 204
    for unknown in (batch_id, "0" * 32, "nothing", "A" * 32):
        assert_refused(world.client.get(f"/batches/{unknown}"), 404, "BATCH_NOT_FOUND")
    assert len(work(world)) == 1
    assert not [key for key in world.blobs.blobs if key.startswith("batches/")]


def test_lists_are_paged(world: World) -> None:
    ids = [posted(world, [one]) for one in pairs(world, 3)]
    page = world.client.get("/batches?limit=2").json()
    rest = world.client.get("/batches", params={"limit": 2, "page_token": page["next_page_token"]}).json()
    assert [one["id"] for one in page["batches"] + rest["batches"]] == ids[::-1]
    assert rest["next_page_token"] is None


def test_a_damaged_batch_is_left_out_and_replaced(world: World) -> None:
    lines = pairs(world, 1)
    batch_id, other = posted(world, lines), posted(world, pairs(world, 2))
    (key,) = [key for key in world.blobs.blobs if key.endswith(batch_id)]
    for damaged in (b"", b"{", b'{"created": 1}\n', b'{"format": 1, "created": 1, "pairs": 1}\n[1]\n', b"\xff\n"):
        world.blobs.put(key, damaged)
        assert world.client.get(f"/batches/{batch_id}").status_code in (404, 503)
        assert other in [one["id"] for one in world.client.get("/batches").json()["batches"]]
    assert posted(world, lines) == batch_id
    assert document(world, batch_id)["status"] == "running"


# what befalls it at the same time


def test_lists_and_looks_beside_deletes_and_cancels_fail_in_no_way(world: World) -> None:
    lines = [pairs(world, 2, options={"up_axis": axis}) for axis in "xyz"]
    statuses: dict[str, set[int]] = {"post": set(), "cancel": set(), "delete": set(), "look": set()}
    ended = threading.Event()

    def change(mine: list[dict[str, Any]]) -> None:
        for _ in range(6):
            answer = post(world, mine)
            address = f"/batches/{answer.json()['id']}"
            statuses["post"].add(answer.status_code)
            statuses["cancel"].add(world.client.post(f"{address}/cancel").status_code)
            statuses["delete"].add(world.client.delete(address).status_code)

    def look() -> None:
        while not ended.is_set():
            answer = world.client.get("/batches")
            statuses["look"].add(answer.status_code)
            for one in answer.json().get("batches", []):
                statuses["look"] |= {world.client.get(one["links"]["self"] + "/results").status_code}

    with ThreadPoolExecutor(5) as pool:
        looking = [pool.submit(look) for _ in range(2)]
        try:
            list(pool.map(change, lines))
        finally:
            ended.set()
        for one in looking:
            one.result()
    most = {"post": {200, 202}, "cancel": {200, 202, 404}, "delete": {204, 404}, "look": {200, 404}}
    assert all(statuses[name] <= most[name] for name in most), statuses
    assert world.queue.registrations == []
    bystander = posted(world, pairs(world, 3))
    assert len(work(world)) == 3
    assert document(world, bystander)["status"] == "finished"


def test_the_same_pairs_spelled_differently_and_posted_at_once_are_one_batch(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = pairs(world, 5)
    longer = [{**one, "options": {"preset": "robust"}} for one in lines]
    whole, meeting = LocalBlobWriter.commit, threading.Barrier(2)

    def commit(writer: LocalBlobWriter, key: str) -> None:
        if key.startswith("batches/"):
            meeting.wait(20)
        whole(writer, key)

    monkeypatch.setattr(LocalBlobWriter, "commit", commit)
    with ThreadPoolExecutor(2) as pool:
        answers = list(pool.map(lambda mine: post(world, mine), (lines, longer)))
    assert {answer.status_code for answer in answers} == {202}
    (batch_id,) = {answer.json()["id"] for answer in answers}
    assert len(work(world)) == 5
    assert [one["key"] for one in results(world, batch_id)] == [one["key"] for one in lines]


UNICODE = ("utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32", "utf-32-be")


@pytest.mark.parametrize(("odd", "encodings"), [(", 10 Ċ", UNICODE), ("", ("cp1252",))])
def test_lines_as_another_editor_saves_them(world: World, odd: str, encodings: tuple[str, ...]) -> None:
    """Files that were joined have marks before their lines."""
    mark = "\N{ZERO WIDTH NO-BREAK SPACE}" if odd else ""
    lines = [one | {"key": f"für {number}{odd}"} for number, one in enumerate(pairs(world, 3))]
    plain, written = posted(world, lines), [json.dumps(one, ensure_ascii=False) for one in lines]
    texts = [end.join(["", *written, ""]) for end in ("\n", "\r\n", "\r")]
    texts.append("\n".join(mark + one for one in written) + f"\n{mark}\n")
    for encoding, text in product(encodings, texts):
        data = text.encode(encoding)
        pieces = (data[begin : begin + 7] for begin in range(0, len(data), 7))
        answer = world.client.post("/batches", content=pieces, headers=NDJSON)
        assert (answer.status_code, answer.json()["id"]) == (202, plain), (encoding, answer.text)


class KilledError(Exception):
    """The process ends here."""


def test_a_post_that_dies_midway_is_taken_up_by_the_next(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    for at in range(6):
        lines = pairs(world, 4, options={"sampling": {"views": 2 + at}})
        calls = iter(range(100))
        with monkeypatch.context() as patch:
            for target, name in ((world.queue, "enqueue_jobs"), (world.records.journal, "_accept")):
                whole = getattr(target, name)

                def dying(*args: Any, whole: Any = whole, at: int = at, calls: Any = calls) -> Any:
                    if next(calls) == at:
                        raise KilledError
                    return whole(*args)

                patch.setattr(target, name, dying)
            if at < 5:
                assert post(world, lines).status_code == 500
                assert len(world.client.get("/batches").json()["batches"]) == at, "no half batch"
            batch_id = posted(world, lines)
        assert len(work(world)) == len({one["job"] for one in results(world, batch_id)}) == 4
        assert {world.records.get_job(one["job"]).attempt for one in results(world, batch_id)} == {1}


def test_many_lines_take_few_round_trips(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    lines = pairs(world, 80)
    posted(world, lines[:1])
    sent = counted_round_trips(monkeypatch)
    posted(world, lines)
    assert len(sent) < len(lines)


def test_a_lost_redis_loses_no_pair(world: World) -> None:
    lines = pairs(world, 8)
    for name in ("scene", "object"):
        world.blobs.put(f"fields/{lines[0][name]}/field.safetensors", b"")  # without it the journal forgets the field
    batch_id = posted(world, lines)
    work(world, 3)
    before = results(world, batch_id)
    assert len(before) == 3
    world.redis.flushall()
    assert results(world, batch_id) == before
    assert [one["id"] for one in world.client.get("/batches").json()["batches"]] == [batch_id]
    moments = [0.0]
    rebuilder = Rebuilder(world.records, world.queue, world.blobs)
    settings = world.settings
    reaper = Reaper(world.records, world.queue, world.redis, settings, rebuilder=rebuilder, clock=lambda: moments[-1])
    while not world.queue.registrations and moments[-1] < 600:
        reaper.run_once()  # it queues what Redis has lost
        moments.append(moments[-1] + 15)
    assert document(world, batch_id)["active"] == 5
    assert len(work(world)) == 5
    assert document(world, batch_id)["counts"]["registered"] == 8


def test_a_large_batch_does_not_keep_another_callers_waiting(worlds: Callable[..., World]) -> None:
    """Each caller has a line of its own, and they take turns."""
    world = worlds(api_tokens=TOKENS)
    taken = []
    for name, count in (("alice", 40), ("bob", 3)):
        with client_of(world.app, headers={"Authorization": f"Bearer the-secret-of-{name}"}) as client:
            request: dict[str, Any] = {"detection": BOX}
            for role in ("scene", "object"):
                request[role] = sha256(field_bytes(role))
                client.put(f"/fields/{request[role]}", content=field_bytes(role))
                world.records.update_field(reference_of(name, request[role]), attempt=1, state="ready")
            for waiting in world.queue.waiting:
                if waiting.kind == "import":
                    world.queue.remove(waiting.name)
            lines = [{**request, "seed": seed} for seed in range(count)]
            assert client.post("/batches", content=body_of(lines), headers=NDJSON).status_code == 202
    while len(taken) < 7:
        world.queue.turn()
        name = world.redis.lpop(f"rq:queue:{QUEUE_NAME}")
        taken.append(world.records.get_job(Work.named(QUEUE_NAME, name.decode()).argument).owner)
    assert taken.count("bob") == 3
