# ruff: noqa: E501 -- a mistake is one line of a table
"""What a new user of the client gets wrong: every message names, expects, and says what to do; nothing is sent in vain."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from redis import Redis

from regnf_client import Client
from regnf_core.errors import RegnfError
from tests.client.conftest import pretended
from tests.client.transports import Counted
from tests.contract.asgi import AppTransport
from tests.contract.world import BOX, TOKENS, World, field_bytes, make_world
from tests.mistakes.case import Case, parametrized

ANY = "12" * 32


@pytest.fixture
def counted(world: World) -> Iterator[Counted]:
    transport = AppTransport(world.app)
    yield Counted(transport)
    transport.close()


@pytest.fixture
def client(counted: Counted, world: World, folder: Path) -> Client:
    """Of a service that has two fields, which lie in the current folder too."""
    for name in ("scene", "object"):
        world.ready_field(name)
        (folder / f"{name}.bin.safetensors").write_bytes(field_bytes(name))
    (folder / "photo.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"\0" * 600)
    return Client("http://localhost", transport=counted)


Call = Callable[[Any], object]
SCENE, OBJECT = "scene.bin.safetensors", "object.bin.safetensors"

BEFORE: list[tuple[Case, Call]] = [
    (Case("file misspelled", "FILE_NOT_FOUND", 0, "rom.safetensors", "no such file", "Did you mean room.safetensors"), lambda c: c.register("rom.safetensors", OBJECT, BOX)),
    (Case("folder of no run", "RUN_WITHOUT_CHECKPOINT", 0, "nothing", "checkpoint", "Give the folder of one training run"), lambda c: c.upload("nothing")),
    (Case("no box", "INVALID_DETECTION", 0, "detection is null", "expected", '"min"'), lambda c: c.register(SCENE, OBJECT, None)),
    (Case("box member misspelled", "INVALID_DETECTION", 0, "detection.cnter", "not a member", "Did you mean `center`"), lambda c: c.register(SCENE, OBJECT, {"cnter": [0, 0, 0], "size": [1, 1, 1]})),
    (Case("option misspelled", "INVALID_OPTIONS", 0, "options.upaxis", "no such option", "did you mean `up_axis`"), lambda c: c.register(SCENE, OBJECT, BOX, {"upaxis": "z"})),
    (Case("text for options", "INVALID_OPTIONS", 0, "options is a str", "expected a dictionary", "up_axis"), lambda c: c.register(SCENE, OBJECT, BOX, "robust")),
    (Case("no job", "INVALID_JOB", 0, "None is no job", "job", "return value of `submit`"), lambda c: c.wait(None)),
    (Case("path for a job", "INVALID_JOB", 0, "out/job", "is no job", "`id`"), lambda c: c.result("out/job")),
    (Case("pair beyond the lists", "PAIR_UNKNOWN", 0, r"no pair \(1, 0\)", "1 detections", "start at 0"), lambda c: c.register_batch(SCENE, [BOX], [OBJECT], [(1, 0)])),
    (Case("one object for a search", "INVALID_INPUT", 0, "objects", "must be a list", r"\[object\]"), lambda c: c.search(SCENE, OBJECT, BOX)),
    (Case("search among nothing", "LIBRARY_EMPTY", 0, "objects", "is empty", "Give the candidates"), lambda c: c.search(SCENE, [], BOX)),
    (Case("file that is no field", "FORMAT_NOT_RECOGNIZED", 0, "photo.png", "picture|image|PNG", "docs/import-gate.md|checkpoint"), lambda c: c.upload("photo.png")),
]  # fmt: skip
AFTER: list[tuple[Case, Call]] = [
    (Case("field that is not there", "FIELD_NOT_FOUND", 404, "field", "Upload|no such", "upload"), lambda c: c.register(ANY, ANY, BOX)),
    (Case("job that is not there", "JOB_NOT_FOUND", 404, "job", "job", "client.jobs"), lambda c: c.job("0" * 32)),
    (Case("result too early", "JOB_NOT_READY", 409, "result", "no result yet", "client.wait"), lambda c: c.result(c.submit(SCENE, OBJECT, BOX))),
    (Case("box in millimeters", "DETECTION_OUTSIDE_SCENE", 422, "units from the scene", "the scene reaches from|center is", "millimeters"), lambda c: c.register(SCENE, OBJECT, {"center": [300, 400, 500], "size": [100, 100, 100]})),
    (Case("webhook that is not allowed", "WEBHOOK_NOT_ALLOWED", 422, "webhook|host", "allow", "allow|operator"), lambda c: c.submit(SCENE, OBJECT, BOX, more={"webhook": {"url": "https://example.org/x"}})),
    (Case("member that is not known", "INVALID_REQUEST", 422, "sede", "unknown", "Did you mean `seed`"), lambda c: c.submit(SCENE, OBJECT, BOX, more={"sede": 3})),
]  # fmt: skip


def assert_refused(case: Case, call: Callable[[], object]) -> None:
    with pytest.raises(RegnfError) as caught:
        call()
    assert caught.value.reason == case.reason, caught.value
    if case.code:
        assert getattr(caught.value, "status", None) == case.code
    case.check(f"{caught.value}\n{caught.value.hint or ''}")


@pytest.mark.parametrize(("case", "call"), [pytest.param(*one, id=one[0].name) for one in BEFORE])
def test_what_is_refused_before_anything_is_sent(case: Case, call: Call, client: Client, counted: Counted) -> None:
    assert_refused(case, lambda: call(client))
    assert counted.requests == []


@pytest.mark.parametrize(("case", "call"), [pytest.param(*one, id=one[0].name) for one in AFTER])
def test_what_the_service_refuses(case: Case, call: Call, client: Client) -> None:
    assert_refused(case, lambda: call(client))


MADE = [
    Case("address without http", "INVALID_ADDRESS", 0, "127.0.0.1:8080", "no http://", "Did you mean http://127.0.0.1:8080", {"address": "127.0.0.1:8080"}),
    Case("scheme misspelled", "INVALID_ADDRESS", 0, "htp://localhost", "no http://", "regnf serve", {"address": "htp://localhost"}),
    Case("token with Bearer", "INVALID_TOKEN", 0, "token", "characters", "without `Bearer`", {"token": "Bearer the-secret-of-alice"}),
    Case("token with a line break", "INVALID_TOKEN", 0, "token", "characters", "line breaks", {"token": "the-secret\nof-alice"}),
]  # fmt: skip


@parametrized(MADE)
def test_what_no_client_is_made_of(case: Case) -> None:
    assert_refused(case, lambda: Client(**case.how))


def test_a_service_that_does_not_run_or_is_another() -> None:
    case = Case("", "SERVICE_UNAVAILABLE", 0, "http://127.0.0.1:1", "does not answer", "regnf serve")
    with Client("http://127.0.0.1:1", retries=0) as client:
        assert_refused(case, client.jobs)
    case = Case("", "SERVICE_ERROR", 0, "the response is not a valid Job", "id", "another service")
    assert_refused(case, lambda: pretended(lambda _: httpx.Response(200, json={"status": "fine"})).job("j"))
    case = Case(
        "", "SERVICE_ERROR", 0, "HTTP status 200 from http://service/jobs/j", "no regnf service", "Check address"
    )
    for text in ("<html>", "[]"):
        assert_refused(case, lambda text=text: pretended(lambda _: httpx.Response(200, text=text)).job("j"))  # type: ignore[misc]


@pytest.mark.parametrize("token", [None, "the-secret-of-eve"])
def test_a_token_that_is_missing_or_wrong(token: str | None, tmp_path: Path, any_redis: Redis, folder: Path) -> None:
    world = make_world(tmp_path, any_redis, api_tokens=TOKENS)
    transport = AppTransport(world.app)
    case = Case("", "UNAUTHENTICATED", 401, "token|Authorization", "valid token|token", "REGNF_API_TOKEN")
    with world.client, Client("http://localhost", token, transport=transport) as client:
        assert_refused(case, client.jobs)
