"""Addresses that people open in a browser answer with a page there, and with JSON to programs."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.contract.world import ALICE, TOKENS, World, assert_refused

BROWSER = {"Accept": "text/html,application/xhtml+xml,application/xml;q=0.9,*/*;q=0.8"}
PAGES = ("/", "/v1/", "/jobs", "/fields", "/v1/jobs", "/v1/fields")
FOLLOWED = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "document"}


@pytest.mark.parametrize("address", PAGES)
def test_browser_gets_a_page_and_a_program_json(world: World, address: str) -> None:
    page = world.client.get(address, headers=BROWSER)
    assert (page.status_code, page.headers["content-type"].split(";")[0]) == (200, "text/html")
    assert page.headers["content-security-policy"].startswith("default-src 'self'")
    assert "<script" in page.text
    for accept in ("*/*", "application/json", "application/json, text/html", ""):
        answer = world.client.get(address, headers={"Accept": accept})
        assert answer.headers["content-type"] == "application/json", accept
        assert answer.headers["vary"] == page.headers["vary"] == "Accept"


def test_page_needs_no_token_and_its_data_do(worlds: Callable[..., World]) -> None:
    world = worlds(api_tokens=TOKENS)
    world.client.headers.pop("Authorization", None)
    for address in PAGES:
        assert world.client.get(address, headers=BROWSER).status_code == 200
        assert_refused(world.client.get(address), 401, "UNAUTHENTICATED")
        assert_refused(world.client.post(address, headers=BROWSER), 401, "UNAUTHENTICATED")
    assert "text/html" in world.client.head("/", headers=BROWSER).headers["content-type"]
    for address in ("/version", "/demo", "/jobs/", "/openapi.yaml", f"/fields/{'0' * 64}"):
        assert_refused(world.client.get(address, headers=BROWSER), 401, "UNAUTHENTICATED")
    assert world.client.get("/jobs", headers=BROWSER | ALICE).headers["content-type"].startswith("text/html")


def test_links_of_other_sites_lead_to_the_pages(world: World) -> None:
    for address in PAGES:
        assert world.client.get(address, headers=BROWSER | FOLLOWED).status_code == 200
    assert_refused(world.client.get("/demo", headers=BROWSER | FOLLOWED), 403, "ORIGIN_NOT_ALLOWED")


def test_mesh_of_a_ready_field(world: World) -> None:
    known = world.ready_field("a")
    address = world.client.get(f"/v1/fields/{known}").json()["links"]["mesh"]
    assert address == f"/v1/fields/{known}/mesh.glb"
    assert_refused(world.client.get(address), 404, "FIELD_MESH_NOT_FOUND")
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
        assert_refused(refused, 404, "FIELD_MESH_NOT_FOUND")
        assert refused.headers["retry-after"] == "1"
        assert world.client.get(address).json()["views"] == "pending"
    assert world.records.undrawn_fields() == [other, known]
    assert "retry-after" in world.client.get(f"/fields/{known}/preview.png").headers
    assert world.records.undrawn_fields() == [known, other], "the one asked for last is drawn first"
    world.records.update_field(known, views="none")
    refused = world.client.get(f"/fields/{known}/mesh.glb")
    assert_refused(refused, 404, "FIELD_MESH_NOT_FOUND")
    assert "retry-after" not in refused.headers


def test_demo(worlds: Callable[..., World], tmp_path: Path) -> None:
    box = {"center": [0, 0, 0], "size": [1, 1, 1]}
    for name in ("mix-room.safetensors", "armchair.safetensors"):
        (tmp_path / name).write_bytes(name.encode())
    world = worlds(demo_dir=tmp_path)
    assert_refused(world.client.get("/demo"), 404, "NOT_FOUND")  # not complete
    (tmp_path / "detection.json").write_text(json.dumps(box))
    (tmp_path / "secret").write_bytes(b"no part of it")
    demo = world.client.get("/v1/demo").json()
    assert (demo["scene"]["bytes"], demo["detection"]) == (20, box)
    assert world.client.get(demo["object"]["address"]).content == b"armchair.safetensors"
    for name in ("secret", "detection.json", "..%2fsecret", "%2e%2e/secret"):
        assert world.client.get(f"/demo/{name}").status_code == 404


def test_service_without_a_demo(world: World) -> None:
    assert_refused(world.client.get("/demo"), 404, "NOT_FOUND")
    assert_refused(world.client.get("/demo/armchair.safetensors"), 404, "NOT_FOUND")
