"""Webhooks over HTTP: who may name which, and what a job says of its own."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from redis import Redis

from tests.contract.live import eventually, live_service
from tests.contract.test_live_transport import submit
from tests.contract.world import World, assert_refused, make_world

SECRET = f"whsec_{base64.b64encode(bytes(24)).decode()}"
URL = "https://hooks.example.org/job"


@pytest.fixture
def told(tmp_path: Path, any_redis: Redis) -> Iterator[World]:
    made = make_world(
        tmp_path,
        any_redis,
        webhook_hosts=frozenset({"hooks.example.org"}),
        webhook_secrets=frozenset({f"anonymous:{SECRET}"}),
    )
    with made.client:
        yield made


@pytest.mark.parametrize(
    ("webhook", "reason"),
    [
        ({"url": "https://elsewhere.example.org/"}, "WEBHOOK_NOT_ALLOWED"),
        ({"url": "http://169.254.169.254/latest"}, "WEBHOOK_NOT_ALLOWED"),
        ({"url": "https://[::1"}, "WEBHOOK_NOT_ALLOWED"),
        ({"url": 1}, "INVALID_WEBHOOK"),
        ({"url": "https://hooks.example.org/" + "a" * 2000}, "INVALID_WEBHOOK"),
        ({}, "INVALID_WEBHOOK"),
        ({"url": URL, "secret": "x"}, "INVALID_WEBHOOK"),
        (URL, "INVALID_WEBHOOK"),
    ],
)
@pytest.mark.parametrize("query", ["", "?dry_run=true"])
def test_refused(told: World, webhook: Any, reason: str, query: str) -> None:
    answer = told.client.post(f"/register{query}", json=told.valid_request() | {"webhook": webhook})
    problem = assert_refused(answer, 422, reason)
    assert all(entry["pointer"].startswith("/webhook") for entry in problem["errors"])
    assert told.records.list_jobs(None, 10, None) == []


def test_without_a_secret_of_ones_own_there_is_none(tmp_path: Path, any_redis: Redis) -> None:
    hosts, secrets = frozenset({"hooks.example.org"}), frozenset({f"somebody:{SECRET}"})
    world = make_world(tmp_path, any_redis, webhook_hosts=hosts, webhook_secrets=secrets)
    with world.client as client:
        asked = world.valid_request() | {"webhook": {"url": URL}}
        assert_refused(client.post("/register", json=asked), 422, "WEBHOOK_NOT_ALLOWED")


def test_the_job_says_how_its_message_fares(told: World) -> None:
    job_id = told.submit(webhook={"url": URL})
    webhook = told.client.get(f"/jobs/{job_id}").json()["webhook"]
    assert (webhook["url"], webhook["state"], webhook["sends"]) == (URL, "waiting", 0)
    listed = told.client.get("/jobs").json()["jobs"][0]["webhook"]
    assert (listed["url"], listed["state"]) == (URL, None)
    plain = told.submit()
    assert plain != job_id
    assert told.client.get(f"/jobs/{plain}").json()["webhook"] is None


def test_a_real_service_sends_what_is_due(tmp_path: Path) -> None:
    """Nobody listens: the job's document says so, and that it will be tried again. No process or log has the secret."""
    settings = {
        "webhook_hosts": '["http://127.0.0.1:1"]',
        "webhook_secrets": f'["anonymous:{SECRET}"]',
        "log_format": "json",
    }
    with live_service(tmp_path, with_worker=False, **settings) as live, live.client() as client:
        plain = submit(client)
        request = {"scene": client.get(f"/jobs/{plain}").json()["inputs"]["scene"]}
        asked = request | {
            "object": client.get(f"/jobs/{plain}").json()["inputs"]["object"],
            "detection": {"min": [0, 0, 0], "max": [1, 1, 1]},
            "webhook": {"url": "http://127.0.0.1:1/x"},
        }
        job_id = client.post("/register", json=asked).json()["id"]
        client.post(f"/jobs/{job_id}/cancel")

        def sent() -> dict[str, Any] | None:
            found: dict[str, Any] = client.get(f"/jobs/{job_id}").json()["webhook"]
            return found if found["sends"] else None

        webhook = eventually(sent, "a send")
        assert (webhook["state"], webhook["last_error"]) == ("pending", "CONNECTION_FAILED")
        assert webhook["next_at"] is not None
        assert SECRET[6:] not in live.log()
        assert SECRET[6:].encode() not in Path(f"/proc/{live.api.pid}/cmdline").read_bytes()
