"""`If-None-Match` as RFC 9110 defines it: weak comparison, lists, `*`; on every address that sends an ETag."""

from __future__ import annotations

import threading

import pytest

from regnf_service.http.ranges import parse_if_none_match
from regnf_state.records import FieldRecord
from tests.contract.world import World, field_bytes

ETAG = '"abc.1"'
HEADERS: dict[str, tuple[tuple[str | None, ...], tuple[bool, bool]]] = {
    "held": ((ETAG, f"W/{ETAG}", f'"x", {ETAG}', f'W/"x" ,,W/{ETAG} ', "*", " * ", f'"a,b", {ETAG}'), (True, False)),
    "another": (('"x"', 'W/"x", "abc"', '"x,abc.1"', '""'), (False, True)),
    "malformed": ((None, "", "abc.1", f"{ETAG} {ETAG}", f"w/{ETAG}", f"{ETAG}, *", '"abc', '"abc.1 "'), (False, False)),
}


@pytest.mark.parametrize("kind", HEADERS)
def test_a_version_matches_or_differs_and_a_malformed_header_sets_no_condition(kind: str) -> None:
    headers, (matches, differs) = HEADERS[kind]
    for header in headers:
        held = parse_if_none_match(header)
        assert (held.matches(ETAG), held.matches(f"W/{ETAG}"), held.differs(ETAG)) == (matches, matches, differs), (
            header
        )
        assert held.given == (kind != "malformed"), header


def addresses(world: World) -> list[str]:
    """One of each kind of address that sends an ETag."""
    job, known, asked = world.submit(), world.ready_field("a"), "a" * 64
    world.succeed(job, {"trace.json": b"[]"})
    now = world.records.now()
    error = {"reason": "LAYOUT_AMBIGUOUS", "candidates": [{"picture": True}]}
    world.records.create_field(FieldRecord(asked, "rejected", 1, now, now, error=error, original_until=now + 60.0))
    places = [f"/fields/{known}/preview.png", f"/fields/{asked}/candidates/1.png"]
    for place in places:
        world.blobs.put(place[1:], b"a picture")
    return [*places, f"/jobs/{job}", f"/fields/{known}", f"/jobs/{job}/artifacts/trace.json"]


def test_every_etag_is_honored(world: World) -> None:
    for path in addresses(world):
        of_a_job = path.startswith("/jobs/") and path.count("/") == 2
        for method in ("GET",) if of_a_job else ("GET", "HEAD"):
            whole = world.client.request(method, path)
            etag = whole.headers["etag"]
            for header in (etag, f"W/{etag}", f'"other", W/{etag}', "*"):
                answer = world.client.request(method, path, headers={"If-None-Match": header})
                assert (answer.status_code, answer.content) == (304, b""), header
                assert [answer.headers[one] for one in ("etag", "cache-control")] == [
                    etag,
                    whole.headers["cache-control"],
                ]
            for header in ('"other"', "odd"):
                assert world.client.request(method, path, headers={"If-None-Match": header}).status_code == 200


def test_an_etag_holds_until_something_changes_and_a_heartbeat_is_no_change(world: World) -> None:
    job_id = world.submit()
    path = f"/jobs/{job_id}"
    etag = world.client.get(path).headers["etag"]
    assert world.client.get(path, headers={"If-None-Match": etag}).status_code == 304
    world.run(job_id)
    changed = world.client.get(path, headers={"If-None-Match": etag})
    assert changed.status_code == 200
    world.records.heartbeat(job_id, 1)
    assert world.client.get(path, headers={"If-None-Match": changed.headers["etag"]}).status_code == 304


@pytest.mark.parametrize("weak", ["", "W/"])
def test_waiting_with_an_etag_ends_at_the_first_change(world: World, weak: str) -> None:
    job_id, data = world.submit(), field_bytes("new")
    sent = world.client.post("/fields", content=data)
    etag = world.client.get(f"/jobs/{job_id}").headers["etag"]
    changes = [
        (f"/jobs/{job_id}", etag, threading.Timer(0.1, world.run, (job_id,)), "status", "running"),
        (sent.headers["location"], sent.headers["etag"],
         threading.Timer(0.1, world.records.update_field, (sent.json()["sha256"],), {"label": "a room"}), "label",
         "a room"),
    ]  # fmt: skip
    for path, held, change, member, value in changes:
        change.start()
        answer = world.client.get(path, params={"wait": 20}, headers={"If-None-Match": weak + held})
        change.join()
        assert (answer.status_code, answer.json()[member]) == (200, value)
