"""Every refusal is a problem, every answer bears its request's id, and nothing of ours or of the caller's leaks."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import pytest
from redis.exceptions import ConnectionError as RedisConnectionError

from regnf_service.http.problems import SECURITY_HEADERS
from regnf_service.upkeep.housekeeping import Housekeeper
from regnf_service.upkeep.reaper import Reaper
from tests.contract.world import NOBODY, World, assert_refused

ALLOWED = {
    "/fields/" + "0" * 64: "DELETE, GET, HEAD, PATCH, PUT", "/v1/fields": "GET, POST", "/jobs/x": "DELETE, GET",
    "/jobs/x/cancel": "POST", "/healthz": "GET, HEAD", "/v1/": "GET, HEAD", "/register": "POST",
    "/static/favicon.svg": "GET, HEAD",
}  # fmt: skip


def test_unknown_addresses_and_methods(world: World) -> None:
    for path in ("/nowhere", "/static/nothing.js", "/static/../app.py", "/static/%2e%2e/app.py"):
        assert_refused(world.client.get(path), 404, "NOT_FOUND")
    for path, allowed in ALLOWED.items():
        answer = world.client.request("TRACE", path)
        assert_refused(answer, 405, "METHOD_NOT_ALLOWED")
        assert answer.headers["allow"] == allowed


def test_a_request_id_is_taken_over_and_an_odd_one_replaced(world: World) -> None:
    for given in ("abc-123", "a.b_c", "x" * 128):
        headers = {"X-Request-ID": given}
        assert world.client.get("/healthz", headers=headers).headers["x-request-id"] == given
        assert world.client.get("/nowhere", headers=headers).json()["request_id"] == given
    odd: list[Any] = ["", "x" * 129, "a b", "a;b", "<script>", b"a\xffb", "a\tb"]
    for given in odd:
        made = world.client.get("/healthz", headers={"X-Request-ID": given}).headers["x-request-id"]
        assert (len(made), made.isalnum()) == (32, True)


def test_faults_of_ours_tell_nothing_but_the_request_id(
    world: World, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("secret value 42")

    monkeypatch.setattr(world.records, "list_jobs", broken)
    with caplog.at_level(logging.ERROR):
        answer = world.client.get("/jobs", headers={"X-Request-ID": "find-me"})
    assert_refused(answer, 500, "INTERNAL")
    assert {name: answer.headers[name] for name in SECURITY_HEADERS} == SECURITY_HEADERS
    assert "secret" not in answer.text
    assert "ZeroDivisionError" not in answer.text
    assert "find-me" in caplog.text
    assert "secret value 42" in caplog.text


def test_records_that_are_away_are_said_to_be_away(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    def away(*_: object) -> None:
        raise RedisConnectionError("Error 111 connecting to 10.0.0.7:6379")

    request = world.valid_request()
    for name, method, path in (
        ("get_job", "GET", "/jobs/x"),
        ("list_jobs", "GET", "/jobs"),
        ("get_field", "GET", "/fields/" + "0" * 64),
        ("create_jobs", "POST", "/register"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(world.records, name, away)
            answer = world.client.request(method, path, json=request)
        assert_refused(answer, 503, "STORAGE_UNAVAILABLE")
        assert int(answer.headers["retry-after"]) > 0
        assert "10.0.0.7" not in answer.text


def test_no_input_comes_back(world: World) -> None:
    marker = "zqxj-marker"
    answers = [
        world.client.get(f"/jobs?limit={marker}"),
        world.client.get(f"/jobs?page_token={marker}"),
        world.client.put("/fields/abc", content=marker.encode()),
        world.client.post("/register", json={"scene": marker, "object": [marker], "detection": {"label": [marker]}}),
        world.client.post("/register", content=marker, headers={"Content-Type": marker}),
        world.client.post("/register", json={marker + "<b>": 1}),
        world.client.get("/jobs/x/events", headers={"Last-Event-ID": marker}),
        world.client.get("/jobs", headers={"X-Request-ID": marker + ";"}),
    ]
    for answer in answers:
        assert marker not in answer.text
        assert marker not in str(answer.headers)


def test_event_ids_that_nobody_gave(world: World) -> None:
    job_id = world.submit()
    world.succeed(job_id)
    odd: list[Any] = ["x", "1-2-3", "-", "9" * 40, "0-0\u00b2".encode(), "$"]
    for given in odd:
        answer = world.client.get(f"/jobs/{job_id}/events", headers={"Last-Event-ID": given})
        assert_refused(answer, 400, "INVALID_HEADER")


# who may call: with any token configured, every call but the probe and the page's own files needs one


CALLS = [("POST", "/docs"), ("GET", "/v1/jobs"), ("GET", "/nowhere"), ("GET", f"/jobs/{NOBODY}/view/x"),
         ("POST", f"/jobs/{NOBODY}/view"), ("GET", "/demo"), ("GET", "/jobs/")]  # fmt: skip
"""Beside the operations of the contract, of which test_openapi has each."""


def test_without_a_token(guarded: World) -> None:
    for method, path in CALLS:
        answer = guarded.client.request(method, path)
        assert_refused(answer, 401, "UNAUTHENTICATED")
        assert answer.headers["www-authenticate"].startswith("Bearer"), (method, path)


def test_tokens(guarded: World) -> None:
    wrong = ("", "Bearer", "Bearer ", "Bearer third-token", "Bearer first-token2", "Basic first-token", "first-token")
    for given in wrong:
        assert_refused(guarded.client.get("/jobs", headers={"Authorization": given}), 401, "UNAUTHENTICATED")
    for given in ("Bearer first-token", "bearer second-token"):
        assert guarded.client.get("/jobs", headers={"Authorization": given}).status_code == 200


def test_the_probe_and_the_page_are_open_and_tell_nothing(guarded: World) -> None:
    assert guarded.client.get("/healthz").json() == {"status": "ok"}
    page = guarded.client.get(f"/jobs/{NOBODY}/view")
    assert (page.status_code, page.headers["content-type"]) == (200, "text/html; charset=utf-8")
    assert guarded.client.get("/static/js/app.js").status_code == guarded.client.get("/docs").status_code == 200


@pytest.mark.parametrize(
    ("settings", "addresses", "status"),
    [
        ({}, ("10.0.0.5", "[2001:db8::1]", "[::ffff:10.0.0.5]"), 401),
        ({}, ("127.0.0.1", "[::1]", "[::ffff:127.0.0.1]"), 200),
        ({"allow_unauthenticated": True}, ("10.0.0.5",), 200),
        ({"publish": "127.0.0.1:8080"}, ("10.0.0.5",), 200),
        ({"publish": "0.0.0.0:8080"}, ("10.0.0.5",), 401),
    ],
)
def test_without_tokens_only_loopback_is_served(
    worlds: Callable[..., World], settings: dict[str, Any], addresses: tuple[str, ...], status: int
) -> None:
    client = worlds(**settings).client
    for address in addresses:
        answer = client.get(f"http://{address}/jobs")
        assert answer.status_code == status, address
        if status == 401:
            assert_refused(answer, 401, "UNAUTHENTICATED")
        assert client.get(f"http://{address}/healthz").status_code == 200


# records of other releases and damaged ones, over HTTP: no 500, no list without the others, no round that ends


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


def test_a_manifest_that_cannot_be_read_has_a_reason(world: World) -> None:
    job_id = world.submit()
    world.succeed(job_id)
    for text in (b"{", b"[]", b'{"format": 7}'):
        world.blobs.put(f"jobs/{job_id}/manifest.json", text)
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
