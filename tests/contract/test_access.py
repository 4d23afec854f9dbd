"""Tokens: with any configured, every call but the probe and the page's own files needs one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from redis import Redis

from tests.contract.world import NOBODY, World, assert_refused, make_world

TOKENS = frozenset({"first-token", "second-token"})
CALLS = [
    ("GET", "/"), ("GET", "/readyz"), ("GET", "/version"), ("GET", "/openapi.yaml"), ("POST", "/docs"),
    ("GET", "/openapi.json"),
    ("GET", f"/jobs/{NOBODY}/request"),
    ("GET", "/jobs"), ("GET", f"/jobs/{NOBODY}"), ("GET", f"/jobs/{NOBODY}/events"), ("GET", f"/jobs/{NOBODY}/result"),
    ("GET", f"/jobs/{NOBODY}/artifacts/trace.json"), ("POST", f"/jobs/{NOBODY}/cancel"), ("DELETE", f"/jobs/{NOBODY}"),
    ("POST", "/register"), ("GET", "/fields"), ("POST", "/fields"), ("PUT", f"/fields/{NOBODY * 2}"),
    ("GET", f"/fields/{NOBODY * 2}"), ("DELETE", f"/fields/{NOBODY * 2}"), ("GET", "/v1/jobs"), ("GET", "/nowhere"),
    ("POST", f"/jobs/{NOBODY}/view"), ("GET", f"/jobs/{NOBODY}/view/x"),
]  # fmt: skip


@pytest.mark.parametrize(("method", "path"), CALLS)
def test_without_a_token(guarded: World, method: str, path: str) -> None:
    answer = guarded.client.request(method, path)
    assert_refused(answer, 401, "UNAUTHENTICATED")
    assert answer.headers["www-authenticate"].startswith("Bearer")


@pytest.mark.parametrize(
    "given", ["", "Bearer", "Bearer ", "Bearer third-token", "Bearer first-token2", "Basic first-token", "first-token"]
)
def test_with_a_wrong_token(guarded: World, given: str) -> None:
    assert_refused(guarded.client.get("/jobs", headers={"Authorization": given}), 401, "UNAUTHENTICATED")


@pytest.mark.parametrize("given", ["Bearer first-token", "bearer second-token"])
def test_with_a_good_token(guarded: World, given: str) -> None:
    assert guarded.client.get("/jobs", headers={"Authorization": given}).status_code == 200


def test_the_probe_and_the_page_are_open_and_tell_nothing(guarded: World) -> None:
    assert guarded.client.get("/healthz").json() == {"status": "ok"}
    page = guarded.client.get(f"/jobs/{NOBODY}/view")
    assert (page.status_code, page.headers["content-type"]) == (200, "text/html; charset=utf-8")
    assert guarded.client.get("/static/js/app.js").status_code == 200
    assert guarded.client.get("/docs").status_code == 200


@pytest.mark.parametrize(
    ("address", "settings", "status"),
    [
        ("10.0.0.5", {}, 401),
        ("2001:db8::1", {}, 401),
        ("::ffff:10.0.0.5", {}, 401),
        ("127.0.0.1", {}, 200),
        ("::1", {}, 200),
        ("::ffff:127.0.0.1", {}, 200),
        ("10.0.0.5", {"allow_unauthenticated": True}, 200),
        ("10.0.0.5", {"publish": "127.0.0.1:8080"}, 200),
        ("10.0.0.5", {"publish": "0.0.0.0:8080"}, 401),
    ],
)
def test_without_tokens_only_loopback_is_served(
    tmp_path: Path, any_redis: Redis, address: str, settings: dict[str, Any], status: int
) -> None:
    host = f"[{address}]" if ":" in address else address
    made = make_world(tmp_path, any_redis, **settings)
    with made.client as client:
        answer = client.get(f"http://{host}/jobs")
        if status == 401:
            assert_refused(answer, 401, "UNAUTHENTICATED")
        assert answer.status_code == status
        assert client.get(f"http://{host}/healthz").status_code == 200
