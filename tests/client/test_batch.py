"""Client.batch: an iterable of requests in, results as they come."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from regnf_client import AsyncClient, Client, Pair, PairResult, ServiceError
from tests.client.conftest import pretended
from tests.contract.asgi import AppTransport
from tests.contract.batch_rounds import Rounds
from tests.contract.world import BOX, RESULT, World


@pytest.fixture
def working(world: World) -> Iterator[Rounds]:
    """The service's rounds, and a worker that has every job succeed, until the test ends."""
    rounds, ended = Rounds(world), threading.Event()
    world.valid_request()

    def run() -> None:
        while not ended.wait(0.02):
            rounds.feed()
            rounds.work()

    worker = threading.Thread(target=run)
    worker.start()
    yield rounds
    ended.set()
    worker.join()


def requests(world: World, count: int) -> Iterator[dict[str, Any]]:
    for number in range(count):
        yield {**world.valid_request(), "seed": number, "key": f"pair {number}"}


def test_results_come_with_the_keys_of_their_requests(world: World, working: Rounds, transport: AppTransport) -> None:
    shares: list[float] = []
    with Client("http://localhost", transport=transport) as client:
        found = list(client.batch(requests(world, 5), progress=lambda _, share: shares.append(share)))
        assert sorted((one.index, one.key) for one in found) == [(n, f"pair {n}") for n in range(5)]
        assert {one.verdict for one in found} == {"registered"}
        assert np.allclose(found[0].T_object_scene, RESULT["T_object_scene"]["matrix"])  # type: ignore[index, arg-type]
        assert found[0].scale == pytest.approx(2.0)
        assert (found[0].error, shares[-1]) == (None, 1.0)
        assert client.result(found[0]).job == found[0].job  # type: ignore[arg-type]
        again = list(client.batch(requests(world, 5)))
    assert [one.job for one in again] == [one.job for one in found]


def test_a_pair_that_fails_stops_no_other(
    world: World, working: Rounds, transport: AppTransport, tmp_path: Path
) -> None:
    good = next(requests(world, 1))
    bad: list[Any] = [
        {**good, "key": "nowhere", "scene": "0" * 64},
        {**good, "key": "no file", "scene": tmp_path / "nothing.ckpt"},
        {**good, "key": "no box", "detection": {"min": [0, 0, 0]}},
        {"key": "no scene"},
        7,
    ]
    with Client("http://localhost", transport=transport) as client:
        found = {one.index: one for one in client.batch([*bad, good])}
    reasons = [one.error and one.error.reason for _, one in sorted(found.items())]
    assert reasons[:3] == ["FIELD_NOT_FOUND", "FILE_NOT_FOUND", "INVALID_DETECTION"]
    assert reasons[3:] == ["INVALID_REQUEST", "INVALID_REQUEST", None]
    assert found[0].status == "failed"
    assert found[1].key == "no file"


def test_the_same_to_be_awaited(world: World, working: Rounds) -> None:
    async def run() -> list[PairResult]:
        transport = httpx.ASGITransport(world.app)
        async with AsyncClient("http://localhost", transport=transport) as client:
            return [one async for one in client.batch(requests(world, 3))]

    assert sorted(one.index for one in asyncio.run(run())) == [0, 1, 2]


def test_failed_pairs_that_are_repeated_are_told_once() -> None:
    """Of an earlier pass only what is not repeated is told; then what this pass finds."""
    earlier = [line(1, 1, "failed"), line(2, 2, "refused"), line(3, 3, "successful")]
    later = [line(4, 1, "successful")]
    status = {"id": "b", "pairs": 3, "passes": 2, "results": 3, "status": "running"}

    def answer(request: httpx.Request) -> httpx.Response:
        if request.method == "POST":
            return httpx.Response(202, json=status)
        after = int(request.url.params["after"])
        lines = earlier if after == 0 else later if after == 3 else []
        return httpx.Response(200, text="".join(lines), headers={"Batch-Status": "finished" if after else "running"})

    pair = Pair("0" * 64, "1" * 64, BOX)
    found = list(pretended(answer).batch([pair] * 3))
    assert [(one.index, one.status) for one in found] == [(1, "refused"), (2, "successful"), (0, "successful")]


def line(number: int, pair: int, status: str) -> str:
    error = None if status == "successful" else {"reason": "JOB_TIMEOUT", "detail": "too long", "status": 500}
    told = {"number": number, "pair": pair, "line": pair, "key": None, "job": "j", "status": status, "error": error}
    return json.dumps(told) + "\n"


def test_a_batch_that_is_cancelled_elsewhere_says_so() -> None:
    status = {"id": "b", "pairs": 1, "passes": 1, "results": 0, "status": "running"}

    def answer(request: httpx.Request) -> httpx.Response:
        dismissed = {"Batch-Status": "dismissed"}
        return httpx.Response(202, json=status) if request.method == "POST" else httpx.Response(200, headers=dismissed)

    with pytest.raises(ServiceError) as caught:
        list(pretended(answer).batch([Pair("0" * 64, "1" * 64, BOX)]))
    assert caught.value.reason == "CANCELLED"


def test_a_refused_batch_is_an_error() -> None:
    problem = {"reason": "QUOTA_BATCHES", "detail": "enough"}
    with pytest.raises(ServiceError) as caught:
        list(pretended(lambda _: httpx.Response(429, json=problem)).batch([Pair("0" * 64, "1" * 64, BOX)]))
    assert caught.value.reason == "QUOTA_BATCHES"
