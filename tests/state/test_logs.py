"""Logs: one JSON object an entry, which tells whose request and which job it belongs to, and nothing that was sent."""

from __future__ import annotations

import io
import json
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from anyio import from_thread, to_thread
from redis import Redis

from regnf_state.logs import ACCESS_LOGGER, JsonFormatter, configure_logging, log_context
from regnf_state.ownership import reference_of
from tests.contract.world import BOX, NOBODY, World, field_bytes, make_world, sha256


@pytest.fixture
def lines() -> Iterator[io.StringIO]:
    """What is logged meanwhile, in JSON."""
    stream = io.StringIO()
    handler = logging.StreamHandler(stream)
    handler.setFormatter(JsonFormatter())
    logger = logging.getLogger("regnf_service")
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    yield stream
    logger.removeHandler(handler)
    logger.setLevel(before)


def entries(lines: io.StringIO) -> list[dict[str, Any]]:
    return [json.loads(line) for line in lines.getvalue().splitlines()]


@pytest.fixture
def world(tmp_path: Path, any_redis: Redis) -> Iterator[World]:
    made = make_world(tmp_path, any_redis, api_tokens=frozenset({"alice:alices-secret-token"}))
    made.client.headers["Authorization"] = "Bearer alices-secret-token"
    with made.client:
        yield made


def test_a_request_is_one_entry_with_its_id_caller_and_job(world: World, lines: io.StringIO) -> None:
    shas = []
    for name in ("scene", "object"):
        data = field_bytes(name)
        world.client.post("/fields", content=data)
        world.records.update_field(reference_of("alice", sha256(data)), state="ready")
        shas.append(sha256(data))
    asked = {"scene": shas[0], "object": shas[1], "detection": BOX}
    job_id = world.client.post("/register", json=asked).json()["id"]
    before = len(entries(lines))
    world.client.get(f"/jobs/{job_id}?wait=0", headers={"X-Request-ID": "find-me"})
    (entry,) = entries(lines)[before:]
    told = {name: entry[name] for name in ("logger", "method", "route", "status", "request_id", "caller", "job_id")}
    assert told == {
        "logger": "regnf_service.access",
        "method": "GET",
        "route": "/jobs/{id}",
        "status": 200,
        "request_id": "find-me",
        "caller": "alice",
        "job_id": job_id,
    }
    assert 0 <= entry["seconds"] < 30


def test_nothing_that_was_sent_is_repeated(world: World, lines: io.StringIO) -> None:
    odd = "zq-marker"
    for headers in ({}, {"Authorization": f"Bearer {odd}"}, {"X-Request-ID": f"{odd} {odd}\t{odd}"}):
        world.client.get(f"/jobs/{NOBODY}?{odd}={odd}", headers=headers)
        world.client.get(f"/{odd}/{odd}", headers=headers)
        world.client.post("/register", content=odd.encode(), headers=headers)
        world.client.get(f"/jobs/{odd}%0d%0a{odd}", headers=headers)
    text = lines.getvalue()
    assert odd not in text
    assert "alices-secret-token" not in text
    assert {entry["caller"] for entry in entries(lines)} == {"alice", "anonymous"}


def test_a_fault_is_logged_with_its_request(world: World, lines: io.StringIO, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(world.records, "list_jobs", lambda *_: 1 / 0)
    world.client.get("/jobs", headers={"X-Request-ID": "broken-1"})
    access, fault = entries(lines)
    assert (fault["level"], fault["request_id"], fault["caller"]) == ("ERROR", "broken-1", "alice")
    assert "ZeroDivisionError" in fault["traceback"]
    assert (access["status"], access["request_id"]) == (500, "broken-1")


def test_probes_are_not_worth_a_line(world: World, lines: io.StringIO) -> None:
    for path in ("/healthz", "/readyz", "/static/js/app.js", "/v1/healthz"):
        world.client.get(path)
    assert lines.getvalue() == ""


def test_threads_bear_what_they_were_started_with(lines: io.StringIO) -> None:
    logger = logging.getLogger("regnf_service.test")

    async def work() -> None:
        with log_context(job_id="j1", caller="alice"):
            await to_thread.run_sync(logger.info, "inside")
        await to_thread.run_sync(logger.info, "outside")

    with from_thread.start_blocking_portal() as portal:
        portal.call(work)
    inside, outside = entries(lines)
    assert (inside["job_id"], inside["caller"]) == ("j1", "alice")
    assert "job_id" not in outside


@pytest.mark.parametrize(("log_format", "listed"), [("json", True), ("text", False)])
def test_requests_are_listed_for_machines_only(log_format: Any, listed: bool) -> None:
    root, access = logging.getLogger(), logging.getLogger(ACCESS_LOGGER)
    before = root.handlers[:], root.level, access.level
    try:
        configure_logging(log_format)
        assert access.isEnabledFor(logging.INFO) is listed
    finally:
        root.handlers, level, access_level = before
        root.setLevel(level)
        access.setLevel(access_level)
