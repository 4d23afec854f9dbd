"""What is asked again, after how long, and what is told at once."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import httpx
import pytest

from regnf_client import ServiceError, UnreachableError
from tests.client.conftest import pretended

JOB = {"id": "j", "kind": "registration", "status": "running"}


def refusal(status: int = 429, reason: str = "RATE_LIMITED", after: str | None = "3") -> httpx.Response:
    headers = {} if after is None else {"Retry-After": after}
    return httpx.Response(status, json={"reason": reason, "detail": "not now"}, headers=headers)


LIMITS = ("RATE_LIMITED", "TOO_MANY_REQUESTS_AT_ONCE")
WAITED = [
    *((429, reason, "3", 3.0, 6.0) for reason in LIMITS),
    (409, "ARTIFACT_NOT_READY", "1", 1.0, 2.0),
    (503, "STORAGE_UNAVAILABLE", "7", 7.0, 14.0),
    *((status, "STORAGE_UNAVAILABLE", None, 0.0, 60.0) for status in (502, 503, 504)),
]


@pytest.mark.parametrize(("status", "reason", "after", "least", "most"), WAITED)
def test_what_passes_is_asked_again_when_the_service_says(
    status: int, reason: str, after: str | None, least: float, most: float, slept: list[float], tmp_path: Path
) -> None:
    answers = [refusal(status, reason, after)] * 4 + [httpx.Response(200, json=JOB)]
    assert pretended(lambda _: answers.pop(0)).job("j").status == "running"
    assert len(slept) == 4
    assert all(least <= wait <= most for wait in slept)
    assert after or slept[-1] > slept[0]
    answers = [refusal(status, reason, after), httpx.Response(200, content=b"bytes")]
    path = pretended(lambda _: answers.pop(0)).download("j", "a.ply", tmp_path / "a.ply")
    assert path.read_bytes() == b"bytes"


def test_patience_ends(slept: list[float]) -> None:
    with pytest.raises(ServiceError) as caught:
        pretended(lambda _: refusal(after="10")).job("j")
    assert (caught.value.reason, caught.value.status) == ("RATE_LIMITED", 429)
    assert 100 < sum(slept) <= 120


@pytest.mark.parametrize(
    "answer",
    [
        refusal(reason="QUOTA_ACTIVE_JOBS"), refusal(after="121"), refusal(after=None), refusal(after="soon"),
        refusal(after="9" * 400), refusal(404, "JOB_NOT_FOUND"), refusal(507, "STORAGE_FULL"),
        refusal(409, "JOB_NOT_READY"),
        httpx.Response(429, text="<html>", headers={"Retry-After": "1"}),
    ],
)  # fmt: skip
def test_what_time_does_not_mend_is_told_at_once(answer: httpx.Response, slept: list[float]) -> None:
    with pytest.raises(ServiceError) as caught:
        pretended(lambda _: answer).job("j")
    assert caught.value.status == answer.status_code
    assert slept == []


def test_nothing_that_answers_is_told_with_what_to_do(slept: list[float]) -> None:
    def broken(request: httpx.Request) -> httpx.Response:
        raise httpx.ConnectError("refused", request=request)

    with pytest.raises(UnreachableError, match="http://service does not answer") as caught:
        pretended(broken, retries=2).job("j")
    assert "regnf serve" in str(caught.value.hint)
    assert len(slept) == 2


def test_a_request_whose_answer_was_lost_is_the_same_request(slept: list[float]) -> None:
    """The second try has the key of the first, so nothing is started anew."""
    keys: list[Any] = []
    field = {"sha256": "a" * 64, "state": "ready", "bytes": 1}

    def answer(request: httpx.Request) -> httpx.Response:
        if request.method == "GET":
            return httpx.Response(200, json=field)
        keys.append(request.headers["idempotency-key"])
        if len(keys) == 1:
            raise httpx.ReadError("lost", request=request)
        return httpx.Response(202, json=JOB)

    box = {"min": [0, 0, 0], "max": [1, 1, 1]}
    assert pretended(answer).submit("a" * 64, "b" * 64, box).id == "j"
    assert len(keys) == 2
    assert keys[0] == keys[1]


@pytest.mark.parametrize("told", [False, True])
def test_a_long_job_costs_few_requests(told: bool, slept: list[float]) -> None:
    """Every change is asked for only by a caller who wants to know."""
    asked: list[httpx.Request] = []

    def answer(request: httpx.Request) -> httpx.Response:
        if request.url.path == "/readyz":
            return httpx.Response(200, json={"checks": {"worker": True}})
        asked.append(request)
        status = "successful" if len(asked) == 3 else "running"
        return httpx.Response(200, json=JOB | {"status": status}, headers={"ETag": f'"{len(asked)}"'})

    said: list[float] = []
    progress = (lambda phase, share: said.append(share)) if told else None
    assert pretended(answer).wait("j", progress=progress).finished
    assert [request.url.query for request in asked] == [b"wait=20"] * 3
    assert [request.headers.get("if-none-match") for request in asked[1:]] == (['"1"', '"2"'] if told else [None, None])
    assert len(said) == (3 if told else 0)


def test_an_upload_is_sent_again_as_a_whole(slept: list[float], tmp_path: Path) -> None:
    path = tmp_path / "field.bin"
    path.write_bytes(b"PK\x03\x04" + bytes(range(256)) * 5_000)
    bodies: list[bytes] = []

    def answer(request: httpx.Request) -> httpx.Response:
        if request.method == "GET":
            return refusal(404, "FIELD_NOT_FOUND", None)
        bodies.append(request.content)
        ready = {"sha256": "ab" * 32, "state": "ready", "bytes": 1_280_000}
        return refusal() if len(bodies) < 3 else httpx.Response(201, json=ready)

    assert pretended(answer).upload(path).state == "ready"
    assert len(bodies) == 3
    assert all(path.read_bytes() in body for body in bodies)
