"""Client.batch: an iterable of requests in, results as they come."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from regnf_client import AsyncClient, Client, Pair, PairResult, ServiceError, WaitTimeoutError
from tests.client.conftest import pretended
from tests.contract.asgi import AppTransport
from tests.contract.batch_posts import work
from tests.contract.world import BOX, RESULT, World


@pytest.fixture
def working(world: World) -> Iterator[World]:
    """A worker has every job succeed, until the test ends."""
    with at_work(world):
        yield world


@contextmanager
def at_work(world: World) -> Iterator[None]:
    ended = threading.Event()
    world.valid_request()

    def run() -> None:
        while not ended.wait(0.02):
            work(world)

    worker = threading.Thread(target=run)
    worker.start()
    try:
        yield
    finally:
        ended.set()
        worker.join()


def requests(world: World, count: int) -> Iterator[dict[str, Any]]:
    for number in range(count):
        yield {**world.valid_request(), "seed": number, "key": f"pair {number}"}


def test_results_come_with_the_keys_of_their_requests(world: World, working: World, transport: AppTransport) -> None:
    shares: list[float] = []
    with Client("http://localhost", transport=transport) as client:
        found = list(client.batch(requests(world, 5), progress=lambda _, share: shares.append(share)))
        assert sorted((one.index, one.key) for one in found) == [(n, f"pair {n}") for n in range(5)]
        assert {(one.verdict, one.level) for one in found} == {("registered", "default")}
        assert np.allclose(found[0].T_object_scene, RESULT["T_object_scene"]["matrix"])  # type: ignore[index, arg-type]
        assert found[0].scale == pytest.approx(2.0)
        assert (found[0].error, shares[-1]) == (None, 1.0)
        assert client.result(found[0]).job == found[0].job  # type: ignore[arg-type]
        again = list(client.batch(requests(world, 5)))
    assert [one.job for one in again] == [one.job for one in found]


def test_a_pair_that_fails_stops_no_other(
    world: World, working: World, transport: AppTransport, tmp_path: Path
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
    assert found[0].status == "refused"
    assert found[1].key == "no file"


def test_the_same_to_be_awaited(world: World, working: World) -> None:
    async def run() -> list[PairResult]:
        transport = httpx.ASGITransport(world.app)
        async with AsyncClient("http://localhost", transport=transport) as client:
            return [one async for one in client.batch(requests(world, 3))]

    assert sorted(one.index for one in asyncio.run(run())) == [0, 1, 2]


def test_more_pairs_than_the_service_has_room_for_become_several_batches(
    worlds: Callable[..., World], monkeypatch: pytest.MonkeyPatch, slept: list[float]
) -> None:
    """Each as large as there is room: here two jobs at once, and three lines a batch."""
    world = worlds(quota_active_jobs=2, max_batch_pairs=3)
    with at_work(world):
        posts = []
        transport = AppTransport(world.app)
        whole = transport.handle_request

        def counted(request: httpx.Request) -> httpx.Response:
            answer = whole(request)
            if (request.method, request.url.path) == ("POST", "/batches"):
                posts.append(answer.status_code)
            return answer

        monkeypatch.setattr(transport, "handle_request", counted)
        with Client("http://localhost", transport=transport) as client:
            found = list(client.batch(requests(world, 7)))
    assert [one.index for one in found] == list(range(7))
    assert {one.verdict for one in found} == {"registered"}
    assert posts.count(202) + posts.count(200) == 4
    assert {413, 429} <= set(posts)


def test_a_full_service_is_waited_for(slept: list[float]) -> None:
    """Other requests of the caller have taken all the room: so long as the service says."""
    answers = iter([(429, 0), (429, 0), (202, None)])

    def answer(request: httpx.Request) -> httpx.Response:
        if request.method == "POST":
            status, fitting = next(answers)
            problem = {"reason": "QUOTA_ACTIVE_JOBS", "detail": "full", "fitting_lines": fitting}
            return httpx.Response(status, json={"id": "b", "pairs": 1} if status == 202 else problem)
        return httpx.Response(200, text=line(1, "successful"))

    found = list(pretended(answer).batch([Pair("0" * 64, "1" * 64, BOX)]))
    assert [(one.index, one.status) for one in found] == [(0, "successful")]
    assert len(slept) == 2


def test_an_interrupted_call_goes_on(worlds: Callable[..., World]) -> None:
    """The second call finds the jobs of the first, in whatever pieces they were posted."""
    world = worlds()
    with Client("http://localhost", transport=AppTransport(world.app)) as client:
        begun = client.batch(requests(world, 4), timeout_s=0)
        with pytest.raises(WaitTimeoutError):
            next(begun)
        jobs = [job_id for job_id, _ in world.queue.registrations]
        assert len(jobs) == 4
        with at_work(world):
            found = [*client.batch(requests(world, 2)), *client.batch(requests(world, 6))]
    assert [one.job for one in found[2:6]] == jobs
    assert {world.records.get_job(one.job).attempt for one in found} == {1}  # type: ignore[union-attr, arg-type]


def line(number: int, status: str) -> str:
    told = {"number": number, "line": number, "key": None, "job": "j", "status": status}
    return json.dumps(told) + "\n"


def test_a_refused_batch_is_an_error() -> None:
    problem = {"reason": "QUOTA_ACTIVE_JOBS", "detail": "enough"}
    with pytest.raises(ServiceError) as caught:
        list(pretended(lambda _: httpx.Response(429, json=problem)).batch([Pair("0" * 64, "1" * 64, BOX)]))
    assert caught.value.reason == "QUOTA_ACTIVE_JOBS"
