"""Webhooks over HTTP: who may name which, and what a job says of its own."""

from __future__ import annotations

import base64
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.contract.live import eventually, live_service
from tests.contract.test_live_transport import submit
from tests.contract.world import World, assert_refused, pointers

SECRET = f"whsec_{base64.b64encode(bytes(24)).decode()}"
URL = "https://hooks.example.org/job"


HOSTS = frozenset({"hooks.example.org"})
BOX = {"min": [-0.4, -0.3, 0.0], "max": [0.1, 0.2, 0.4]}


@pytest.fixture
def told(worlds: Callable[..., World]) -> World:
    return worlds(webhook_hosts=HOSTS, webhook_secrets=frozenset({f"anonymous:{SECRET}"}))


def test_refused(told: World) -> None:
    bad: list[tuple[Any, str]] = [
        *(({"url": url}, "WEBHOOK_NOT_ALLOWED") for url in ("https://elsewhere.example.org/", "https://[::1")),
        ({"url": "http://169.254.169.254/latest"}, "WEBHOOK_NOT_ALLOWED"),
        *(({"url": url}, "INVALID_REQUEST") for url in (1, "https://hooks.example.org/" + "a" * 2000)),
        *((webhook, "INVALID_REQUEST") for webhook in ({}, {"url": URL, "secret": "x"}, URL)),
    ]
    for webhook, reason in bad:
        for query in ("", "?dry_run=true"):
            answer = told.client.post(f"/register{query}", json=told.valid_request() | {"webhook": webhook})
            problem = assert_refused(answer, 422, reason)
            assert all(pointer.startswith("/webhook") for pointer in pointers(problem))
    assert told.records.list_jobs(None, 10, None).records == []


def test_without_a_secret_of_ones_own_there_is_none(worlds: Callable[..., World]) -> None:
    world = worlds(webhook_hosts=HOSTS, webhook_secrets=frozenset({f"somebody:{SECRET}"}))
    asked = world.valid_request() | {"webhook": {"url": URL}}
    assert_refused(world.client.post("/register", json=asked), 422, "WEBHOOK_NOT_ALLOWED")


def test_the_job_says_how_its_message_fares(told: World) -> None:
    job_id = told.submit(webhook={"url": URL})
    (webhook,) = told.client.get(f"/jobs/{job_id}").json()["webhooks"]
    assert (webhook["url"], webhook["state"], webhook["sends"]) == (URL, "waiting", 0)
    (listed,) = told.client.get("/jobs").json()["jobs"][0]["webhooks"]
    assert (listed["url"], listed["state"]) == (URL, None)
    plain = told.submit(seed=1)
    assert told.client.get(f"/jobs/{plain}").json()["webhooks"] == []


def urls(world: World, job_id: str) -> list[str]:
    return [one["url"] for one in world.client.get(f"/jobs/{job_id}").json()["webhooks"]]


@pytest.mark.parametrize("state", ["accepted", "running", "successful"])
def test_a_webhook_makes_no_other_job_and_is_added_to_the_one_there_is(told: World, state: str) -> None:
    job_id = told.submit(webhook={"url": URL})
    if state == "running":
        told.run(job_id)
    if state == "successful":
        told.succeed(job_id)
    for url, is_new in ((f"{URL}/2", True), (f"{URL}/3", True), (f"{URL}/2", False)):
        before = told.client.get(f"/jobs/{job_id}")
        answer = told.client.post("/register", json=told.valid_request() | {"webhook": {"url": url}})
        assert answer.status_code == (200 if state == "successful" else 202)
        assert (answer.json()["id"], answer.json()["status"], answer.json()["attempts"]) == (job_id, state, 1)
        assert (answer.headers["etag"] != before.headers["etag"]) is is_new
    assert urls(told, job_id) == [URL, f"{URL}/2", f"{URL}/3"]
    assert told.job(job_id).request["webhook"] == {"url": URL}


def test_a_job_without_a_webhook_gets_that_of_a_later_request(told: World) -> None:
    job_id = told.submit()
    assert told.submit(webhook={"url": URL}) == job_id
    assert urls(told, job_id) == [URL]


def test_a_job_that_is_started_anew_holds_the_later_request_and_tells_all(told: World) -> None:
    job_id = told.submit(webhook={"url": URL}, detection=BOX | {"label": "chair"})
    told.fail(job_id, reason="WORKER_LOST")
    assert told.submit(webhook={"url": f"{URL}/2"}, detection=BOX | {"label": "armchair"}) == job_id
    assert urls(told, job_id) == [f"{URL}/2", URL]
    record = told.job(job_id)
    assert (record.attempt, record.request["detection"]["label"]) == (2, "armchair")
    assert record.inputs["detection"]["label"] == "armchair"


def test_a_job_takes_sixteen_webhooks(told: World) -> None:
    for number in range(16):
        job_id = told.submit(webhook={"url": f"{URL}/{number}"})
    asked = told.valid_request() | {"webhook": {"url": f"{URL}/16"}}
    assert_refused(told.client.post("/register", json=asked), 409, "QUOTA_WEBHOOKS")
    assert told.submit(webhook={"url": f"{URL}/3"}) == job_id
    told.fail(job_id, reason="WORKER_LOST")
    assert_refused(told.client.post("/register", json=asked), 409, "QUOTA_WEBHOOKS")
    assert len(urls(told, job_id)) == 16


def test_an_idempotency_key_belongs_to_one_webhook(told: World) -> None:
    """Another webhook under the same key would be lost: the answer of the first call knows nothing of it."""
    asked, key = told.valid_request() | {"webhook": {"url": URL}}, {"Idempotency-Key": "run-1"}
    first = told.client.post("/register", json=asked, headers=key)
    again = told.client.post("/register", json=asked, headers=key)
    assert first.json()["id"] == again.json()["id"]
    other = told.client.post("/register", json=asked | {"webhook": {"url": f"{URL}/2"}}, headers=key)
    assert_refused(other, 422, "IDEMPOTENCY_KEY_REUSED")


def test_a_real_service_sends_what_is_due(tmp_path: Path) -> None:
    """Nobody listens: the job's document says so, and that it will be tried again. No process or log has the secret."""
    settings = {
        "webhook_hosts": '["http://127.0.0.1:1"]',
        "webhook_secrets": f'["anonymous:{SECRET}"]',
        "log_format": "json",
    }
    with live_service(tmp_path, with_worker=False, **settings) as live, live.client() as client:
        job_id = submit(client, webhook={"url": "http://127.0.0.1:1/x"})
        client.post(f"/jobs/{job_id}/cancel")

        def sent() -> dict[str, Any] | None:
            (found,) = client.get(f"/jobs/{job_id}").json()["webhooks"]
            return found if found["sends"] else None

        webhook = eventually(sent, "a send")
        assert (webhook["state"], webhook["last_error"]) == ("pending", "CONNECTION_FAILED")
        assert webhook["next_at"] is not None
        assert SECRET[6:] not in live.log()
        assert SECRET[6:].encode() not in Path(f"/proc/{live.api.pid}/cmdline").read_bytes()
