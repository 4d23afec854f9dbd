"""What the service says about itself, and its pages."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from redis.exceptions import ConnectionError as RedisConnectionError

from regnf_core import __version__
from tests.contract.world import ALICE, TOKENS, World, assert_refused


def test_health_and_readiness_and_version(world: World) -> None:
    assert world.client.get("/healthz").json() == {"status": "ok"}
    assert world.client.get("/version").json()["version"] == __version__
    ready = {"status": "ready", "checks": {"records": True, "storage": True, "worker": True}}
    assert world.client.get("/readyz").json() == ready
    assert world.blobs.blobs == {}
    for path in ("/", "/docs", "/healthz", "/readyz", "/version", "/openapi.yaml", "/openapi.json", "/v1/healthz"):
        get, head = world.client.get(path), world.client.head(path)
        assert (head.status_code, head.content) == (200, b""), path
        for name in ("content-type", "content-length"):
            assert head.headers[name] == get.headers[name]


def away() -> bool:
    raise RedisConnectionError("away")


def broken() -> None:
    raise OSError("broken")


@pytest.mark.parametrize(
    ("missing", "reason", "holder", "name", "stand_in"),
    [
        ("records", "STORAGE_UNAVAILABLE", "records", "probe", away),
        ("storage", "STORAGE_UNAVAILABLE", "blobs", "probe", broken),
        ("worker", "NO_WORKER", "queue", "workers", 0),
    ],
)
def test_not_ready_when_something_is_missing(
    world: World, monkeypatch: pytest.MonkeyPatch, missing: str, reason: str, holder: str, name: str, stand_in: Any
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(getattr(world, holder), name, stand_in)
        problem = assert_refused(world.client.get("/readyz"), 503, "NOT_READY")
        head, without = world.client.head("/readyz"), world.client.get("/readyz", params={"worker": "false"})
    assert problem["detail"] == f"Missing: {missing} ({reason})."
    assert [one for one, there in problem["checks"].items() if not there] == [missing]
    assert problem["reasons"] == {missing: reason}
    assert (head.status_code, head.content, "retry-after" in head.headers) == (503, b"", True)
    assert without.status_code == (200 if missing == "worker" else 503)
    assert without.json()["checks"][missing] is False
    assert_refused(world.client.get("/readyz", params={"worker": "maybe"}), 400, "INVALID_QUERY")


def test_the_index_names_every_address_and_the_contract_is_served_as_json_too(world: World) -> None:
    contract = world.app.openapi()
    named = world.client.get("/").json()["addresses"]
    assert len(named) == sum(len(operations) for operations in contract["paths"].values())
    assert "POST /register" in named
    assert "POST /v1/register" in world.client.get("/v1/").json()["addresses"]
    answer = world.client.get("/openapi.json")
    assert (answer.headers["content-type"], answer.json()) == ("application/json", contract)
    assert answer.json()["x-reasons"]["QUEUE_FULL"]["status"] == 503


# addresses that people open in a browser answer with a page there, and with JSON to programs

BROWSER = {"Accept": "text/html,application/xhtml+xml,application/xml;q=0.9,*/*;q=0.8"}
PAGES = ("/", "/v1/", "/jobs", "/fields", "/v1/jobs", "/v1/fields")
FOLLOWED = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "document"}


def test_a_browser_gets_a_page_without_a_token_and_a_program_json_with_one(worlds: Callable[..., World]) -> None:
    client = worlds(api_tokens=TOKENS).client
    for address in PAGES:
        page = client.get(address, headers=BROWSER)
        assert (page.status_code, page.headers["content-type"].split(";")[0]) == (200, "text/html")
        assert page.headers["content-security-policy"].startswith("default-src 'self'")
        assert "<script" in page.text
        assert client.get(address, headers=BROWSER | FOLLOWED).status_code == 200, "links of other sites lead there"
        for accept in ("*/*", "application/json", "application/json, text/html", ""):
            answer = client.get(address, headers=ALICE | {"Accept": accept})
            assert answer.headers["content-type"] == "application/json", accept
            assert answer.headers["vary"] == page.headers["vary"] == "Accept"
        for method, headers in (("GET", {}), ("POST", BROWSER)):
            assert_refused(client.request(method, address, headers=headers), 401, "UNAUTHENTICATED")
    assert "text/html" in client.head("/", headers=BROWSER).headers["content-type"]
    for address in ("/version", "/demo", "/jobs/", "/openapi.yaml", f"/fields/{'0' * 64}"):
        assert_refused(client.get(address, headers=BROWSER), 401, "UNAUTHENTICATED")
    assert client.get("/jobs", headers=BROWSER | ALICE).headers["content-type"].startswith("text/html")
    assert_refused(client.get("/demo", headers=BROWSER | FOLLOWED | ALICE), 403, "ORIGIN_NOT_ALLOWED")


def test_mesh_of_a_ready_field(world: World) -> None:
    known = world.ready_field("a")
    address = world.client.get(f"/v1/fields/{known}").json()["links"]["mesh"]
    assert address == f"/v1/fields/{known}/mesh.glb"
    assert_refused(world.client.get(address), 404, "FIELD_VIEW_NOT_FOUND")
    world.blobs.put(f"fields/{known}/mesh.glb", b"glTF fine")
    for detail in ("fine", "coarse"):
        assert world.client.get(address, params={"detail": detail}).content == b"glTF fine"
    world.blobs.put(f"fields/{known}/mesh-coarse.glb", b"glTF coarse")
    assert world.client.get(address, params={"detail": "coarse"}).content == b"glTF coarse"
    answer = world.client.get(address)
    assert (answer.content, answer.headers["content-type"]) == (b"glTF fine", "model/gltf-binary")
    assert world.client.get(address, headers={"If-None-Match": answer.headers["etag"]}).status_code == 304
    assert world.client.head(address).status_code == 200
    assert_refused(world.client.get(address, params={"detail": "finest"}), 400, "INVALID_QUERY")
    world.client.delete(f"/fields/{known}")
    assert_refused(world.client.get(address), 404, "FIELD_NOT_FOUND")


def test_mesh_that_is_still_to_be_made(world: World) -> None:
    known, other = world.ready_field("a"), world.ready_field("b")
    for field in (known, other):
        address = f"/fields/{field}"
        refused = world.client.get(f"{address}/mesh.glb")
        assert_refused(refused, 404, "FIELD_VIEW_NOT_FOUND")
        assert refused.headers["retry-after"] == "1"
        assert world.client.get(address).json()["views"] == "pending"
    assert world.records.undrawn_fields() == [other, known]
    assert "retry-after" in world.client.get(f"/fields/{known}/preview.png").headers
    assert world.records.undrawn_fields() == [known, other], "the one asked for last is drawn first"
    world.records.update_field(known, views="none")
    refused = world.client.get(f"/fields/{known}/mesh.glb")
    assert_refused(refused, 404, "FIELD_VIEW_NOT_FOUND")
    assert "retry-after" not in refused.headers


def test_demo(worlds: Callable[..., World], tmp_path: Path) -> None:
    box = {"center": [0, 0, 0], "size": [1, 1, 1]}
    for name in ("mix-room.safetensors", "armchair.safetensors"):
        (tmp_path / name).write_bytes(name.encode())
    world = worlds(demo_dir=tmp_path)
    for address in ("/demo", "/demo/armchair.safetensors"):
        assert_refused(world.client.get(address), 404, "NOT_FOUND")  # not complete
    (tmp_path / "detection.json").write_text(json.dumps(box))
    (tmp_path / "secret").write_bytes(b"no part of it")
    demo = world.client.get("/v1/demo").json()
    assert (demo["scene"]["bytes"], demo["detection"]) == (20, box)
    assert world.client.get(demo["object"]["address"]).content == b"armchair.safetensors"
    for name in ("secret", "detection.json", "..%2fsecret", "%2e%2e/secret"):
        assert world.client.get(f"/demo/{name}").status_code == 404
