"""Batches posted as lines, and the rounds in which the feeder makes jobs of them."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any

import httpx

from regnf_service.batches.feeder import Feeder
from regnf_service.http.batch_intake import REQUESTS
from tests.contract.world import World

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
