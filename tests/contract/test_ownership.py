"""Whose is whose: a caller sees its own fields and jobs only, and nothing tells it what others have."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path
from typing import Any

import httpx
import pytest

from regnf_state.ownership import reference_of
from tests.contract.asgi import client_of
from tests.contract.world import BOX, World, assert_refused, field_bytes, sha256
from tests.stores import expire

SCENE, OBJECT = field_bytes("scene"), field_bytes("object")
ALICE, BOB = {"Authorization": "Bearer alices-token"}, {"Authorization": "Bearer bobs-token"}


@pytest.fixture
def shared(tmp_path: Path, worlds: Callable[..., World]) -> World:
    file = tmp_path / "tokens"
    file.write_text("# who may call\n\nalice:alices-token\nbob:bobs-token\nbob:bobs-next-token\n")
    made = worlds(api_tokens=f"@{file}")
    made.client.headers.update(ALICE)
    return made


@pytest.fixture
def bob(shared: World) -> Iterator[httpx.Client]:
    with client_of(shared.app, headers=BOB) as client:
        yield client


def ready(world: World, client: httpx.Client, caller: str, data: bytes, **report: Any) -> str:
    assert client.put(f"/fields/{sha256(data)}", content=data).status_code == 201
    world.records.update_field(reference_of(caller, sha256(data)), state="ready", report=report)
    return sha256(data)


def ask(client: httpx.Client, **changes: Any) -> httpx.Response:
    request = {"scene": sha256(SCENE), "object": sha256(OBJECT), "detection": BOX} | changes
    return client.post("/register", json=request)


@pytest.fixture
def alices_job(shared: World) -> str:
    for data in (SCENE, OBJECT):
        ready(shared, shared.client, "alice", data)
    job_id = str(ask(shared.client).json()["id"])
    shared.succeed(job_id, {"trace.json": b"{}"})
    shared.blobs.put(f"fields/{reference_of('alice', sha256(SCENE))}/picture.png", b"png")
    return job_id


ROUTES = {path: methods.split() for path, methods in {
    "/fields/{field}": "GET HEAD PATCH DELETE", "/fields/{field}?wait=1": "GET", "/fields/{field}/mesh.glb": "GET HEAD",
    "/fields/{field}/preview.png": "GET HEAD", "/fields/{field}/candidates/1.png": "GET HEAD",
    "/library/{entry}": "GET PATCH DELETE", "/library/{entry}/file": "GET",
    "/jobs/{job}": "GET DELETE", "/jobs/{job}?wait=1": "GET", "/jobs/{job}/request": "GET", "/jobs/{job}/events": "GET",
    "/jobs/{job}/result": "GET", "/jobs/{job}/artifacts/trace.json": "GET HEAD", "/jobs/{job}/cancel": "POST",
    "/batches/{batch}": "GET DELETE", "/batches/{batch}?wait=1": "GET", "/batches/{batch}/results": "GET",
    "/batches/{batch}/cancel": "POST",
}.items()}  # fmt: skip
OPEN = {("PUT", "/fields/{field}"), ("GET", "/jobs/{job}/view"), ("HEAD", "/jobs/{job}/view")}


def test_the_table_names_every_route_with_an_id(shared: World) -> None:
    ids = {"{sha256}": "{field}", "{id}": "{job}", "{name}": "trace.json", "{number}": "1"}
    found = set()
    for path, operations in shared.app.openapi()["paths"].items():
        path = path.replace("y/{name}", "y/{entry}").replace("batches/{id}", "batches/{batch}")
        path = re.sub(r"\{(id|sha256|name|number)\}", lambda match: ids[match[0]], path)
        if path.startswith(("/fields/", "/library/", "/jobs/", "/batches/")):
            found |= {(method.upper(), path) for method in operations}
    assert found == OPEN | {(method, path.split("?")[0]) for path, methods in ROUTES.items() for method in methods}


def post_batch(client: httpx.Client) -> dict[str, Any]:
    line = {"scene": sha256(SCENE), "object": sha256(OBJECT), "detection": BOX}
    headers = {"Content-Type": "application/x-ndjson"}
    document: dict[str, Any] = client.post("/batches", content=json.dumps(line), headers=headers).json()
    return document


def test_anothers_is_not_there(shared: World, bob: httpx.Client, alices_job: str) -> None:
    """The answer is the one for an id that nobody has, member by member, and alice's still stands afterwards."""
    shared.client.post("/library", json={"name": "chair", "field": sha256(OBJECT)})
    batch = post_batch(shared.client)["id"]
    theirs = {"field": sha256(SCENE), "job": alices_job, "entry": "chair", "batch": batch}
    nobodys = {"field": "0" * 64, "job": "0" * 32, "entry": "none", "batch": "0" * 32}

    def told(method: str, path: str) -> dict[str, Any]:
        changes = {"tags": ["b"]} if "library" in path else {"description": {"sign": -1}}
        answer = bob.request(method, path, json=changes if method == "PATCH" else None)
        assert answer.status_code == 404, (method, path)
        document = answer.json() if answer.content else {}
        return {name: document[name] for name in document if name not in ("instance", "request_id")}

    for path, methods in ROUTES.items():
        for method, prefix in product(methods, ("", "/v1")):
            assert told(method, prefix + path.format(**theirs)) == told(method, prefix + path.format(**nobodys))
    assert shared.client.get(f"/jobs/{alices_job}/result").status_code == 200
    assert shared.client.get(f"/fields/{sha256(SCENE)}").status_code == 200
    assert shared.client.get("/library/chair").json()["tags"] == []
    assert shared.client.get(f"/batches/{batch}").json()["status"] == "finished"


def test_the_same_lines_are_each_callers_own_batch(shared: World, bob: httpx.Client, alices_job: str) -> None:
    alices = post_batch(shared.client)
    assert bob.get("/batches").json()["batches"] == []
    bobs = post_batch(bob)
    assert bobs["counts"]["refused"] == 1
    assert bobs["id"] != alices["id"]


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


def test_anothers_field_is_of_no_use(bob: httpx.Client, alices_job: str) -> None:
    asked: list[dict[str, Any]] = [
        {"object": sha256(OBJECT)},
        {"object": sha256(SCENE)},
        {"candidates": [sha256(SCENE), sha256(OBJECT)]},
    ]
    for objects in asked:
        for query in ("", "?dry_run=true"):
            answer = bob.post(f"/register{query}", json={"scene": sha256(SCENE), "detection": BOX} | objects)
            assert_refused(answer, 404, "FIELD_NOT_FOUND")


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
    assert bob.delete(f"/fields/{sha256(SCENE)}").status_code == 409
    assert shared.client.delete(f"/fields/{sha256(SCENE)}").status_code == 204, "bob's job is no use of hers"


def test_idempotency_keys_are_each_callers_own_whichever_of_its_tokens_it_sends(
    shared: World, bob: httpx.Client, alices_job: str
) -> None:
    for data in (SCENE, OBJECT):
        ready(shared, bob, "bob", data)
    for client in (shared.client, bob):
        client.headers["Idempotency-Key"] = "one"
    assert ask(shared.client, seed=1).status_code == 202
    assert ask(bob, seed=2).status_code == 202
    bob.headers["Authorization"] = "Bearer bobs-next-token"
    assert bob.get(f"/fields/{sha256(SCENE)}").status_code == 200
    assert_refused(ask(bob, seed=3), 422, "IDEMPOTENCY_KEY_REUSED")


def test_no_answer_tells_how_fields_are_called_inside(shared: World, alices_job: str) -> None:
    client = shared.client
    client.post("/library", json={"name": "chair", "field": sha256(OBJECT)})
    paths = ("/fields", "/jobs", "/library", "/library/chair", f"/jobs/{alices_job}", f"/fields/{sha256(SCENE)}")
    texts = [client.get(path).text for path in paths]
    assert not [text for text in texts if "_alice" in text]
