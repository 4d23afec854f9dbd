"""Batches posted as lines, and a worker's part."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any

import httpx

from tests.contract.world import World

NDJSON = {"Content-Type": "application/x-ndjson"}


def pairs(world: World, count: int, **changes: Any) -> list[dict[str, Any]]:
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


def document(world: World, batch_id: str) -> dict[str, Any]:
    answer = world.client.get(f"/batches/{batch_id}")
    assert answer.status_code == 200, answer.text
    told: dict[str, Any] = answer.json()
    return told


def work(world: World, most: int = 1000) -> list[str]:
    """The jobs that wait succeed, ``most`` at most; their ids."""
    done = []
    for job_id, attempt in world.queue.registrations[:most]:
        world.queue.take(job_id, attempt)
        record = world.records.get_job(job_id)
        if record is not None and record.status == "accepted":  # one may be queued again that has just ended
            world.succeed(job_id)
            done.append(job_id)
    return done
