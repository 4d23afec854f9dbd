"""Every refusal is a problem, every answer bears its request's id, and nothing of ours or of the caller's leaks."""

from __future__ import annotations

import logging
from typing import Any

import pytest
from redis.exceptions import ConnectionError as RedisConnectionError

from tests.contract.world import World, assert_refused

ALLOWED = {
    "/fields/" + "0" * 64: "DELETE, GET, HEAD, PATCH, PUT",
    "/v1/fields": "GET, POST",
    "/jobs/x": "DELETE, GET",
    "/jobs/x/cancel": "POST",
    "/healthz": "GET, HEAD",
    "/v1/": "GET, HEAD",
    "/register": "POST",
    "/static/favicon.svg": "GET, HEAD",
}


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
