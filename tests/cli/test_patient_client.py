"""What the command line does when a service says that it is asked too fast."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import httpx
import pytest

from regnf_cli.remote import PatientClient, RemoteService
from regnf_client.answers import ServiceError
from regnf_core.field_source import FieldSource

Handler = Callable[[httpx.Request], httpx.Response]


def refusal(reason: str = "TOO_MANY_WRITES", after: str | None = "3") -> httpx.Response:
    headers = {} if after is None else {"Retry-After": after}
    return httpx.Response(429, json={"reason": reason, "detail": "too fast"}, headers=headers)


@pytest.fixture
def slept() -> list[float]:
    """The waits, none of which is waited for."""
    return []


class Pretended(httpx.BaseTransport):
    """Has the handler see each body as it would be sent."""

    def __init__(self, handler: Handler) -> None:
        self._handler = handler

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        assert isinstance(request.stream, httpx.SyncByteStream)
        return self._handler(httpx.Request(request.method, request.url, content=b"".join(request.stream)))


def client(handler: Handler, slept: list[float]) -> PatientClient:
    return PatientClient(sleep=slept.append, base_url="http://service", transport=Pretended(handler))


@pytest.mark.parametrize("reason", ["TOO_MANY_WRITES", "RATE_LIMITED", "TOO_MANY_REQUESTS_AT_ONCE", "TOO_MANY_UPLOADS"])
def test_it_asks_again_when_it_was_told_to(reason: str, slept: list[float]) -> None:
    bodies = []

    def handler(request: httpx.Request) -> httpx.Response:
        bodies.append(request.read())
        return refusal(reason) if len(bodies) < 4 else httpx.Response(202, json={"id": "j"})

    answer = client(handler, slept).post("/register", json={"seed": 1})
    assert (answer.status_code, bodies) == (202, [b'{"seed":1}'] * 4)
    assert len(slept) == 3
    assert all(3.0 <= wait <= 6.0 for wait in slept)


def test_its_patience_ends(slept: list[float]) -> None:
    asked = []
    answer = client(lambda request: asked.append(request) or refusal(after="10"), slept).post("/register")
    assert answer.status_code == 429
    assert len(asked) == len(slept) + 1
    assert 100 < sum(slept) <= 120


@pytest.mark.parametrize(
    "answer",
    [
        refusal("QUOTA_WORKER_SECONDS"), refusal("TOO_MANY_WRONG_TOKENS"), refusal(after="121"), refusal(after=None),
        refusal(after="soon"), refusal(after="-1"), refusal(after="9" * 400),
        httpx.Response(429, text="<html>", headers={"Retry-After": "1"}),
        httpx.Response(429, json=["TOO_MANY_WRITES"], headers={"Retry-After": "1"}),
        httpx.Response(503, json={"reason": "TOO_MANY_WRITES"}, headers={"Retry-After": "1"}),
    ],
)  # fmt: skip
def test_what_time_does_not_mend_is_told_at_once(answer: httpx.Response, slept: list[float]) -> None:
    assert client(lambda _: answer, slept).post("/register").status_code == answer.status_code
    assert slept == []


def test_a_stream_is_asked_for_again(slept: list[float]) -> None:
    answers = [refusal("RATE_LIMITED"), httpx.Response(200, content=b"bytes")]
    with client(lambda _: answers.pop(0), slept).stream("GET", "/jobs/j/artifacts/a") as answer:
        assert b"".join(answer.iter_bytes()) == b"bytes"
    assert len(slept) == 1


@pytest.mark.parametrize("described", [False, True])
def test_an_upload_is_sent_again_as_a_whole(
    described: bool, slept: list[float], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "field.bin"
    path.write_bytes(bytes(range(256)) * 5_000)  # of several blocks
    bodies: list[bytes] = []

    def handler(request: httpx.Request) -> httpx.Response:
        if request.method == "GET":
            return httpx.Response(404, json={"reason": "FIELD_NOT_FOUND"})
        bodies.append(request.read())
        return refusal() if len(bodies) < 3 else httpx.Response(201, json={"state": "validating"})

    service = RemoteService("http://service")
    monkeypatch.setattr(service, "_http", client(handler, slept))
    service.send(FieldSource(path, path, role="object" if described else None))
    assert len(bodies) == 3
    assert bodies[0] == bodies[1] == bodies[2]
    assert path.read_bytes() in bodies[2]


def test_a_service_that_goes_on_refusing_is_told_of(slept: list[float], monkeypatch: pytest.MonkeyPatch) -> None:
    service = RemoteService("http://service")
    monkeypatch.setattr(service, "_http", client(lambda _: refusal(), slept))
    with pytest.raises(ServiceError) as caught:
        service.submit({"seed": 1})
    assert caught.value.reason == "TOO_MANY_WRITES"
    assert "again" in str(caught.value.hint)
    assert slept
