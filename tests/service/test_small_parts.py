"""Ranges, digests, page tokens, strict JSON, preferences: the small readings of a request."""

from __future__ import annotations

import base64
import errno
import hashlib
import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from regnf_core.texts import decode_text
from regnf_service.http.problems import problem_of
from regnf_service.http.query import decode_token, encode_token
from regnf_service.http.ranges import announced_digest, is_sha256, parse_range
from regnf_service.http.routes.registrations import preferred_wait
from regnf_service.http.strict_json import parse_json
from regnf_service.jobs import submit
from regnf_service.jobs.submit import digest, job_id_of
from regnf_service.problem import Problem, json_pointer
from regnf_state.blobs.base import StorageUnavailableError
from regnf_state.reasons import REASONS
from tests.requests import registration_request


@pytest.mark.parametrize(
    ("header", "size", "expected"),
    [
        (None, 10, None), ("bytes=0-0", 10, range(1)), ("bytes=0-9", 10, range(10)),
        ("bytes=0-10", 10, range(10)), ("bytes=3-", 10, range(3, 10)), ("bytes=-3", 10, range(7, 10)),
        ("bytes=-30", 10, range(10)), ("bytes=4-3", 10, None), ("bytes=0-1,4-5", 10, None),
        ("bytes=", 10, None), ("bytes=-", 10, None), ("bytes=\u0661-", 10, None), ("lines=0-1", 10, None),
        ("bytes=" + "9" * 40 + "-", 10, None),
    ],
)  # fmt: skip
def test_ranges(header: str | None, size: int, expected: range | None) -> None:
    assert parse_range(header, size) == expected


@pytest.mark.parametrize(("header", "size"), [("bytes=10-", 10), ("bytes=-0", 10), ("bytes=0-", 0), ("bytes=-5", 0)])
def test_ranges_without_a_byte(header: str, size: int) -> None:
    with pytest.raises(Problem) as refused:
        parse_range(header, size)
    assert refused.value.reason == "RANGE_NOT_SATISFIABLE"


@given(st.integers(0, 50), st.integers(0, 60), st.integers(1, 50))
def test_a_range_never_leaves_the_file(first: int, last: int, size: int) -> None:
    if first >= size:
        return
    part = parse_range(f"bytes={first}-{last}", size)
    if last >= first:
        assert part is not None
        assert bytes(range(size))[part.start : part.stop] == bytes(range(size))[first : last + 1]
    else:
        assert part is None


def test_content_digests() -> None:
    value = hashlib.sha256(b"x").digest()
    text = base64.b64encode(value).decode()
    assert announced_digest(f"sha-256=:{text}:") == value.hex()
    assert announced_digest(f"sha-512=:{base64.b64encode(b'x' * 64).decode()}:, sha-256=:{text}:") == value.hex()
    assert announced_digest("sha-512=:AAAA:") is None
    assert announced_digest(None) is None
    for bad in ("", "sha-256", f"sha-256={text}", "sha-256=:AA:", f"sha-256=:{text[:-2]}!=:", f"sha-256=:{text * 40}:"):
        with pytest.raises(Problem) as refused:
            announced_digest(bad)
        assert refused.value.reason == "INVALID_DIGEST"


def test_names_of_fields() -> None:
    assert is_sha256("0123456789abcdef" * 4)
    for odd in ("", "A" * 64, "a" * 63, "a" * 65, "a" * 64 + "\n", "\u0661" * 64, "../" + "a" * 61):
        assert not is_sha256(odd)


@given(st.floats(0, 1e11), st.text("0123456789abcdef", max_size=64))
def test_page_tokens_come_back(created: float, name: str) -> None:
    assert decode_token(encode_token((created, name))) == (created, name)


def outcome(read: Callable[[Any], Any], value: Any) -> Any:
    """What ``read`` makes of the value, or the reason it gives."""
    try:
        return read(value)
    except Problem as refused:
        return refused.reason


@given(st.text(max_size=60))
def test_other_page_tokens_are_refused_or_harmless(text: str) -> None:
    found = outcome(decode_token, text)
    assert found == "INVALID_QUERY" or (isinstance(found[0], float) and isinstance(found[1], str))


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


def test_pointers_stop_at_names_that_are_not_ours() -> None:
    assert json_pointer(("detection", "size", 1)) == "/detection/size/1"
    assert json_pointer(("options", "<script>")) == "/options"
    assert json_pointer(()) == ""


def test_job_ids_depend_on_what_changes_a_result() -> None:
    request = registration_request("a", "b", do="ä")
    box = request.detection
    assert len(job_id_of(request)) == 32
    assert len({job_id_of(replace(request, seed=seed)) for seed in range(20)}) == 20
    noted = replace(request, detection=replace(box, label="another", score=0.5), webhook="https://example.org/hook")
    assert job_id_of(noted) == job_id_of(request)
    assert job_id_of(replace(request, detection=replace(box, center=(0.0, 1.0, 3.0)))) != job_id_of(request)
    assert job_id_of(request.owned_by("alice")) != job_id_of(request)
    # printf '{"a":[1.5,"x"]}' | sha256sum
    assert digest({"a": [1.5, "x"]}) == hashlib.sha256(b'{"a":[1.5,"x"]}').hexdigest()
    assert digest({"a": 1, "b": 2}) == digest({"b": 2, "a": 1})


def test_another_revision_of_the_engine_gives_other_jobs_and_another_version_does_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    request = registration_request("a", "b")
    known = job_id_of(request)
    monkeypatch.setattr(submit, "__version__", "99.0", raising=False)
    assert job_id_of(request) == known
    monkeypatch.setattr(submit, "ENGINE_REVISION", submit.ENGINE_REVISION + 1)
    assert job_id_of(request) != known


def test_every_reason_is_an_error_with_a_sentence() -> None:
    for name, reason in REASONS.items():
        assert name.isupper()
        assert 400 <= reason.status <= 599
        assert reason.title
        assert reason.meaning.endswith(".")


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
