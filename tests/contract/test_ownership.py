"""Whose is whose: a caller sees its own fields and jobs only, and nothing tells it what others have."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from redis import Redis

from regnf_state.ownership import reference_of
from tests.contract.asgi import client_of
from tests.contract.world import BOX, World, assert_refused, field_bytes, make_world, sha256
from tests.stores import expire

SCENE, OBJECT = field_bytes("scene"), field_bytes("object")
ALICE, BOB = {"Authorization": "Bearer alices-token"}, {"Authorization": "Bearer bobs-token"}


@pytest.fixture
def shared(tmp_path: Path, any_redis: Redis) -> Iterator[World]:
    """A service of two callers; its client is alice's."""
    file = tmp_path / "tokens"
    file.write_text("# who may call\n\nalice:alices-token\nbob:bobs-token\nbob:bobs-next-token\n")
    made = make_world(tmp_path, any_redis, api_tokens=f"@{file}")
    made.client.headers.update(ALICE)
    with made.client:
        yield made


@pytest.fixture
def bob(shared: World) -> Iterator[httpx.Client]:
    with client_of(shared.app, headers=BOB) as client:
        yield client


def ready(world: World, client: httpx.Client, caller: str, data: bytes, **report: Any) -> str:
    """A caller's field whose import went well."""
    assert client.put(f"/fields/{sha256(data)}", content=data).status_code == 201
    world.records.update_field(reference_of(caller, sha256(data)), state="ready", report=report)
    return sha256(data)


def ask(client: httpx.Client, **changes: Any) -> httpx.Response:
    request = {"scene": sha256(SCENE), "object": sha256(OBJECT), "detection": BOX} | changes
    return client.post("/register", json=request)


@pytest.fixture
def alices_job(shared: World) -> str:
    """A finished job of alice's with an artifact, her fields ready."""
    for data in (SCENE, OBJECT):
        ready(shared, shared.client, "alice", data)
    job_id = str(ask(shared.client).json()["id"])
    shared.succeed(job_id, {"trace.json": b"{}"})
    shared.blobs.put(f"fields/{reference_of('alice', sha256(SCENE))}/picture.png", b"png")
    return job_id


FIELD_ROUTES = [
    ("GET", "/fields/{field}"),
    ("HEAD", "/fields/{field}"),
    ("GET", "/fields/{field}?wait=1"),
    ("GET", "/fields/{field}/mesh.glb"),
    ("HEAD", "/fields/{field}/mesh.glb"),
    ("GET", "/fields/{field}/preview.png"),
    ("HEAD", "/fields/{field}/preview.png"),
    ("GET", "/fields/{field}/candidates/1.png"),
    ("HEAD", "/fields/{field}/candidates/1.png"),
    ("PATCH", "/fields/{field}"),
    ("DELETE", "/fields/{field}"),
]
ENTRY_ROUTES = [
    ("GET", "/library/{entry}"),
    ("GET", "/library/{entry}/file"),
    ("PATCH", "/library/{entry}"),
    ("DELETE", "/library/{entry}"),
]
JOB_ROUTES = [
    ("GET", "/jobs/{job}"),
    ("GET", "/jobs/{job}?wait=1"),
    ("GET", "/jobs/{job}/request"),
    ("GET", "/jobs/{job}/events"),
    ("GET", "/jobs/{job}/result"),
    ("GET", "/jobs/{job}/artifacts/trace.json"),
    ("HEAD", "/jobs/{job}/artifacts/trace.json"),
    ("POST", "/jobs/{job}/cancel"),
    ("DELETE", "/jobs/{job}"),
]
BATCH_ROUTES = [
    ("GET", "/batches/{batch}"),
    ("GET", "/batches/{batch}?wait=1"),
    ("GET", "/batches/{batch}/results"),
    ("POST", "/batches/{batch}/cancel"),
    ("DELETE", "/batches/{batch}"),
]


def test_the_tables_name_every_route_with_an_id(shared: World) -> None:
    named = {(method, path.split("?")[0]) for method, path in FIELD_ROUTES + ENTRY_ROUTES + JOB_ROUTES + BATCH_ROUTES}
    named |= {("PUT", "/fields/{field}"), ("GET", "/jobs/{job}/view"), ("HEAD", "/jobs/{job}/view")}
    ids = {
        "{entry}": "{entry}",
        "{batch}": "{batch}",
        "{sha256}": "{field}",
        "{id}": "{job}",
        "{name}": "trace.json",
        "{number}": "1",
    }
    told = shared.app.openapi()["paths"].items()
    paths = {
        path.replace("y/{name}", "y/{entry}").replace("batches/{id}", "batches/{batch}"): ops for path, ops in told
    }
    spelled = {
        (method.upper(), re.sub(r"\{\w+\}", lambda found: ids[found[0]], path))
        for path, operations in paths.items()
        for method in operations
        if path.startswith(("/fields/", "/library/", "/jobs/", "/register", "/batches"))
    }
    assert spelled - {("POST", "/register"), ("POST", "/batches"), ("GET", "/batches")} == named


@pytest.mark.parametrize("prefix", ["", "/v1"])
@pytest.mark.parametrize(("method", "path"), FIELD_ROUTES + ENTRY_ROUTES + JOB_ROUTES)
def test_anothers_is_not_there(
    shared: World, bob: httpx.Client, alices_job: str, method: str, path: str, prefix: str
) -> None:
    """The answer is the one for an id that nobody has, member by member, and alice's still stands afterwards."""
    shared.client.post("/library", json={"name": "chair", "field": sha256(OBJECT)})
    changes = {"/fields": {"description": {"sign": -1}}, "/library": {"tags": ["b"]}}
    body = next(one for part, one in changes.items() if part in path) if method == "PATCH" else None
    answer = bob.request(method, prefix + path.format(field=sha256(SCENE), job=alices_job, entry="chair"), json=body)
    unknown = bob.request(method, prefix + path.format(field="0" * 64, job="0" * 32, entry="none"), json=body)
    assert answer.status_code == unknown.status_code == 404
    told, untold = (dict(one.json()) if one.content else {} for one in (answer, unknown))
    for document in (told, untold):
        document.pop("instance", None)
        document.pop("request_id", None)
    assert told == untold
    assert shared.client.get(f"/jobs/{alices_job}/result").status_code == 200
    assert shared.client.get(f"/fields/{sha256(SCENE)}").status_code == 200
    assert shared.client.get("/library/chair").json()["tags"] == []


def test_a_library_is_each_callers_own(shared: World, bob: httpx.Client, alices_job: str) -> None:
    entry = {"name": "chair", "field": sha256(OBJECT)}
    assert shared.client.post("/library", json=entry).status_code == 201
    assert bob.get("/library").json()["entries"] == []
    assert_refused(bob.post("/library", json=entry), 404, "FIELD_NOT_FOUND")
    ready(shared, bob, "bob", OBJECT)
    assert bob.post("/library", json=entry).status_code == 201, "the name is alice's, and bob's too"
    assert bob.delete("/library/chair").status_code == 204
    assert shared.client.get("/library/chair").status_code == 200
    named = {"scene": sha256(SCENE), "object": {"library": "chair"}, "detection": BOX}
    assert_refused(bob.post("/register", json=named), 404, "LIBRARY_ENTRY_NOT_FOUND")


@pytest.mark.parametrize("prefix", ["", "/v1"])
@pytest.mark.parametrize(("method", "path"), BATCH_ROUTES)
def test_anothers_batch_is_not_there(
    shared: World, bob: httpx.Client, alices_job: str, method: str, path: str, prefix: str
) -> None:
    line = {"scene": sha256(SCENE), "object": sha256(OBJECT), "detection": BOX}
    content, headers = json.dumps(line).encode(), {"Content-Type": "application/x-ndjson"}
    posted = shared.client.post("/batches", content=content, headers=headers)
    assert posted.status_code == 200, posted.text
    assert_refused(bob.request(method, prefix + path.format(batch=posted.json()["id"])), 404, "BATCH_NOT_FOUND")
    assert bob.get("/batches").json()["batches"] == []
    assert shared.client.get(f"/batches/{posted.json()['id']}").json()["status"] == "finished"
    if method == "GET":
        bobs = bob.post("/batches", content=content, headers=headers).json()
        assert bobs["counts"]["refused"] == 1, "the same lines are each caller's own batch"
        assert bobs["id"] != posted.json()["id"]


def test_a_job_that_has_expired_is_gone_to_its_owner_and_unknown_to_others(
    shared: World, bob: httpx.Client, alices_job: str
) -> None:
    expire(shared.redis, alices_job)
    for clean_up in (list, shared.records.expire_jobs):
        clean_up()
        assert_refused(shared.client.get(f"/jobs/{alices_job}"), 410, "JOB_EXPIRED")
        assert_refused(bob.get(f"/jobs/{alices_job}"), 404, "JOB_NOT_FOUND")


def test_lists_hold_ones_own(shared: World, bob: httpx.Client, alices_job: str) -> None:
    assert bob.get("/fields").json()["fields"] == bob.get("/jobs").json()["jobs"] == []
    ready(shared, bob, "bob", OBJECT)
    assert [field["sha256"] for field in bob.get("/fields").json()["fields"]] == [sha256(OBJECT)]
    assert len(shared.client.get("/fields").json()["fields"]) == 2
    assert [job["id"] for job in shared.client.get("/jobs").json()["jobs"]] == [alices_job]
    first = shared.client.get("/fields?limit=1").json()
    assert bob.get("/fields", params={"page_token": first["next_page_token"]}).json()["next_page_token"] is None


@pytest.mark.parametrize(
    "changes",
    [{}, {"object": sha256(SCENE)}, {"object": None, "candidates": [sha256(SCENE), sha256(OBJECT)]}],
    ids=["both", "object", "search"],
)
def test_anothers_field_is_of_no_use(bob: httpx.Client, alices_job: str, changes: dict[str, Any]) -> None:
    request = {"scene": sha256(SCENE), "object": sha256(OBJECT), "detection": BOX} | changes
    given = {name: value for name, value in request.items() if value is not None}
    for query in ("", "?dry_run=true"):
        assert_refused(bob.post(f"/register{query}", json=given), 404, "FIELD_NOT_FOUND")


def test_the_same_bytes_are_each_callers_own(shared: World, bob: httpx.Client, alices_job: str) -> None:
    """New to bob in every way: 201, to be imported, without alice's label; and alice's outlives his deletion."""
    described = {"file": ("f", SCENE), "description": ("d", b'{"label": "my room"}', "application/json")}
    answer = bob.post("/fields", files=described)
    assert (answer.status_code, answer.json()["state"], answer.json()["label"]) == (201, "validating", "my room")
    assert shared.client.get(f"/fields/{sha256(SCENE)}").json()["label"] is None
    assert (reference_of("bob", sha256(SCENE)), 1) in shared.queue.imports
    assert bob.delete(f"/fields/{sha256(SCENE)}").status_code == 204
    assert shared.client.get(f"/fields/{sha256(SCENE)}").json()["state"] == "ready"
    assert shared.blobs.exists(f"fields/{reference_of('alice', sha256(SCENE))}/picture.png")


def test_a_put_without_the_bytes_tells_nothing(bob: httpx.Client, alices_job: str) -> None:
    for known in (sha256(SCENE), "0" * 64):
        assert_refused(bob.put(f"/fields/{known}", content=b""), 400, "UPLOAD_INCOMPLETE")
        assert_refused(bob.put(f"/fields/{known}", content=field_bytes("other")), 400, "DIGEST_MISMATCH")


def test_the_same_question_is_each_callers_own_job(shared: World, bob: httpx.Client, alices_job: str) -> None:
    for data in (SCENE, OBJECT):
        ready(shared, bob, "bob", data)
    answer = ask(bob)
    assert answer.status_code == 202, "alice's has finished, and would have been answered at once"
    assert answer.json()["id"] != alices_job
    assert answer.json()["inputs"]["scene"] == sha256(SCENE)
    assert bob.post("/register?dry_run=true", json={"scene": sha256(SCENE), "object": sha256(OBJECT), "detection": BOX}
                    ).json()["request"]["scene"] == sha256(SCENE)  # fmt: skip
    assert bob.delete(f"/fields/{sha256(SCENE)}").status_code == 409
    assert shared.client.delete(f"/fields/{sha256(SCENE)}").status_code == 204, "bob's job is no use of hers"


def test_idempotency_keys_are_each_callers_own(shared: World, bob: httpx.Client, alices_job: str) -> None:
    for data in (SCENE, OBJECT):
        ready(shared, bob, "bob", data)
    request = {"scene": sha256(SCENE), "object": sha256(OBJECT), "detection": BOX}
    keyed = {"Idempotency-Key": "one"}
    assert shared.client.post("/register", json=request | {"seed": 1}, headers=keyed).status_code == 202
    assert bob.post("/register", json=request | {"seed": 2}, headers=keyed).status_code == 202
    assert_refused(bob.post("/register", json=request | {"seed": 3}, headers=keyed), 422, "IDEMPOTENCY_KEY_REUSED")


def test_a_caller_is_one_whichever_of_its_tokens_it_sends(shared: World, bob: httpx.Client) -> None:
    ready(shared, bob, "bob", SCENE)
    bob.headers["Authorization"] = "Bearer bobs-next-token"
    assert bob.get(f"/fields/{sha256(SCENE)}").status_code == 200


def test_no_answer_tells_how_fields_are_called_inside(shared: World, alices_job: str) -> None:
    client = shared.client
    client.post("/library", json={"name": "chair", "field": sha256(OBJECT)})
    paths = ("/fields", "/jobs", "/library", "/library/chair", f"/jobs/{alices_job}", f"/fields/{sha256(SCENE)}")
    texts = [client.get(path).text for path in paths]
    assert not [text for text in texts if "_alice" in text]
