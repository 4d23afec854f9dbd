"""Digests, strict JSON, preferences, jobs' ids, budgets: small parts that a request over HTTP does not show whole."""

from __future__ import annotations

import base64
import errno
import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from redis import Redis

from regnf_core.texts import decode_text
from regnf_service.http.problems import problem_of
from regnf_service.http.ranges import announced_digest
from regnf_service.http.routes.registrations import preferred_wait
from regnf_service.http.strict_json import parse_json
from regnf_service.jobs import submit
from regnf_service.jobs.submit import check_fields, job_id_of
from regnf_service.problem import Problem
from regnf_state.blobs.base import StorageUnavailableError
from regnf_state.ownership import ANONYMOUS
from regnf_state.records import FieldRecord
from regnf_state.settings import Settings
from tests.requests import registration_request
from tests.round_trips import counted_round_trips
from tests.stores import services_over


def test_content_digests() -> None:
    value = hashlib.sha256(b"x").digest()
    text = base64.b64encode(value).decode()
    assert announced_digest(f"sha-256=:{text}:") == value.hex()
    assert announced_digest(f"sha-512=:{base64.b64encode(b'x' * 64).decode()}:, sha-256=:{text}:") == value.hex()
    assert announced_digest("sha-512=:AAAA:") is announced_digest(None) is None
    for bad in ("", "sha-256", f"sha-256={text}", f"sha-256=:{text[:-2]}!=:", f"sha-256=:{text * 40}:"):
        assert outcome(announced_digest, bad) == "INVALID_DIGEST"


def outcome(read: Callable[[Any], Any], value: Any) -> Any:
    try:
        return read(value)
    except Problem as refused:
        return refused.reason


@given(st.binary(max_size=200))
def test_json_that_python_would_not_read_is_refused(body: bytes) -> None:
    try:
        json.loads(decode_text(body))
        readable = True
    except ValueError:
        readable = False
    assert readable or outcome(parse_json, body) == "MALFORMED_JSON"


def test_strict_json_takes_what_rfc_8259_has() -> None:
    assert parse_json(b' {"a": [1, 2.5, "\\u00e4", null, true], "b": {"a": 1}} ') == {
        "a": [1, 2.5, "ä", None, True],
        "b": {"a": 1},
    }
    whole = parse_json(b"[52.0, 1e2, -0.0, 2.5, 1e300]")
    assert [type(value) for value in whole] == [int, int, int, float, float]
    assert whole == [52, 100, 0, 2.5, 1e300]
    assert parse_json(b"[" * 32 + b"]" * 32)
    with pytest.raises(Problem):
        parse_json(b"[" * 33 + b"]" * 33)


@pytest.mark.parametrize(
    ("header", "seconds"),
    [
        (None, None), ("wait=5", 5), ("respond-async, wait=10", 10), ('wait="7"', 7), ("WAIT = 3", 3),
        ("wait=99999", 30), ("wait=-1", None), ("wait=soon", None), ("waiter=5", None),
    ],
)  # fmt: skip
def test_preferences(header: str | None, seconds: int | None) -> None:
    assert preferred_wait(header) == seconds


def test_another_revision_of_the_engine_gives_other_jobs_and_another_version_does_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    request = registration_request("a", "b")
    known = job_id_of(request)
    monkeypatch.setattr(submit, "__version__", "99.0", raising=False)
    assert job_id_of(request) == known
    monkeypatch.setattr(submit, "ENGINE_REVISION", submit.ENGINE_REVISION + 1)
    assert job_id_of(request) != known


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (FileNotFoundError(errno.ENOENT, "deleted in the meantime"), "NOT_FOUND"),
        (StorageUnavailableError(errno.ENOENT, "the volume is away"), "STORAGE_UNAVAILABLE"),
        (OSError(errno.EIO, "broken"), "STORAGE_UNAVAILABLE"),
    ],
)
def test_what_was_deleted_in_the_meantime_is_no_outage(error: OSError, reason: str) -> None:
    assert problem_of(error).reason == reason


# from a checked request to a job: what it costs


@pytest.mark.parametrize("count", [1, 512])
def test_any_number_of_candidates_is_one_round_trip(
    redis: Redis, tmp_path: Path, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    services = services_over(redis, Settings(state_dir=tmp_path))
    names = [f"{number:064x}" for number in range(count + 1)]
    for name in names:
        services.records.restore_field(FieldRecord(name, "ready", 1, 1.0, 1.0))
    scene, *candidates = names
    sent = counted_round_trips(monkeypatch)
    named = {"/scene": scene} | {f"/candidates/{place}": name for place, name in enumerate(candidates)}
    check_fields(services, ANONYMOUS, registration_request(scene, None, candidates=tuple(candidates)), named)
    assert sent == ["pipeline"]
