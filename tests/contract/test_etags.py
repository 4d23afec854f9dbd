"""`If-None-Match` as RFC 9110 defines it: weak comparison, lists, `*`; on every address that sends an ETag."""

from __future__ import annotations

import threading

import pytest

from regnf_service.http.ranges import parse_if_none_match
from regnf_state.records import FieldRecord
from tests.contract.world import World, field_bytes

ETAG = '"abc.1"'


@pytest.mark.parametrize(
    "header", [ETAG, f"W/{ETAG}", f'"x", {ETAG}', f'W/"x" ,,W/{ETAG} ', "*", " * ", '"a,b", ' + ETAG]
)
def test_a_version_that_the_client_holds_matches(header: str) -> None:
    held = parse_if_none_match(header)
    assert held.matches(ETAG)
    assert held.matches(f"W/{ETAG}")
    assert not held.differs(ETAG)


@pytest.mark.parametrize("header", ['"x"', 'W/"x", "abc"', '"x,abc.1"', '""'])
def test_another_version_differs(header: str) -> None:
    held = parse_if_none_match(header)
    assert held.differs(ETAG)
    assert not held.matches(ETAG)


@pytest.mark.parametrize("header", [None, "", "abc.1", f"{ETAG} {ETAG}", f"w/{ETAG}", f"{ETAG}, *", '"abc', '"abc.1 "'])
def test_a_malformed_header_sets_no_condition(header: str | None) -> None:
    held = parse_if_none_match(header)
    assert not held.given
    assert not held.matches(ETAG)
    assert not held.differs(ETAG)


def artifact_of(world: World) -> str:
    job_id = world.submit()
    world.succeed(job_id, {"trace.json": b"[]"})
    return f"/jobs/{job_id}/artifacts/trace.json"


def preview_of(world: World) -> str:
    known = world.ready_field("scene")
    world.blobs.put(f"fields/{known}/preview.png", b"a picture")
    return f"/fields/{known}/preview.png"


def candidate_of(world: World) -> str:
    now = world.records.now()
    error = {"reason": "LAYOUT_AMBIGUOUS", "candidates": [{"picture": True}]}
    world.records.create_field(FieldRecord("a" * 64, "rejected", 1, now, now, error=error, original_until=now + 60.0))
    world.blobs.put(f"fields/{'a' * 64}/candidates/1.png", b"a picture")
    return f"/fields/{'a' * 64}/candidates/1.png"


ADDRESSES = {
    "candidate": candidate_of,
    "job": lambda world: f"/jobs/{world.submit()}",
    "field": lambda world: f"/fields/{world.ready_field('scene')}",
    "preview": preview_of,
    "artifact": artifact_of,
}


@pytest.mark.parametrize("kind", sorted(ADDRESSES))
@pytest.mark.parametrize("method", ["GET", "HEAD"])
def test_every_etag_is_honored(world: World, kind: str, method: str) -> None:
    path = ADDRESSES[kind](world)
    if kind == "job" and method == "HEAD":
        method = "GET"
    whole = world.client.request(method, path)
    etag = whole.headers["etag"]
    for header in (etag, f"W/{etag}", f'"other", W/{etag}', "*"):
        answer = world.client.request(method, path, headers={"If-None-Match": header})
        assert (answer.status_code, answer.content) == (304, b""), header
        assert answer.headers["etag"] == etag
        assert answer.headers["cache-control"] == whole.headers["cache-control"]
    for header in ('"other"', "odd"):
        assert world.client.request(method, path, headers={"If-None-Match": header}).status_code == 200


def test_a_weakened_etag_does_not_end_a_held_answer(world: World) -> None:
    job_id = world.submit()
    etag = world.client.get(f"/jobs/{job_id}").headers["etag"]
    worker = threading.Timer(0.2, world.run, (job_id,))
    worker.start()
    answer = world.client.get(f"/jobs/{job_id}", params={"wait": 20}, headers={"If-None-Match": f"W/{etag}"})
    worker.join()
    assert (answer.status_code, answer.json()["status"]) == (200, "running")


def test_waiting_for_a_field_with_its_etag_ends_at_the_first_change(world: World) -> None:
    data = field_bytes("scene")
    sent = world.client.post("/fields", content=data)
    path, etag = sent.headers["location"], sent.headers["etag"]
    known = sent.json()["sha256"]
    other = threading.Timer(0.2, world.records.update_field, (known,), {"label": "a room"})
    other.start()
    answer = world.client.get(path, params={"wait": 20}, headers={"If-None-Match": etag})
    other.join()
    assert (answer.status_code, answer.json()["label"]) == (200, "a room")
