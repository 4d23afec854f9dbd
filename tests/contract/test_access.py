"""Who may call: with any token configured, every call but the probe and the page's own files needs one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from tests.contract.world import NOBODY, World, assert_refused

CALLS = [
    ("GET", "/"), ("GET", "/readyz"), ("GET", "/version"), ("GET", "/openapi.yaml"), ("POST", "/docs"),
    ("GET", "/openapi.json"), ("GET", f"/jobs/{NOBODY}/request"), ("GET", "/jobs"), ("GET", f"/jobs/{NOBODY}"),
    ("GET", f"/jobs/{NOBODY}/events"), ("GET", f"/jobs/{NOBODY}/result"),
    ("GET", f"/jobs/{NOBODY}/artifacts/trace.json"),
    ("POST", f"/jobs/{NOBODY}/cancel"), ("DELETE", f"/jobs/{NOBODY}"), ("POST", "/register"), ("GET", "/fields"),
    ("POST", "/fields"), ("PUT", f"/fields/{NOBODY * 2}"), ("GET", f"/fields/{NOBODY * 2}"),
    ("DELETE", f"/fields/{NOBODY * 2}"), ("GET", "/v1/jobs"), ("GET", "/nowhere"), ("POST", f"/jobs/{NOBODY}/view"),
    ("GET", f"/jobs/{NOBODY}/view/x"),
]  # fmt: skip


def test_without_a_token(guarded: World) -> None:
    for method, path in CALLS:
        answer = guarded.client.request(method, path)
        assert_refused(answer, 401, "UNAUTHENTICATED")
        assert answer.headers["www-authenticate"].startswith("Bearer"), (method, path)


def test_tokens(guarded: World) -> None:
    wrong = ("", "Bearer", "Bearer ", "Bearer third-token", "Bearer first-token2", "Basic first-token", "first-token")
    for given in wrong:
        assert_refused(guarded.client.get("/jobs", headers={"Authorization": given}), 401, "UNAUTHENTICATED")
    for given in ("Bearer first-token", "bearer second-token"):
        assert guarded.client.get("/jobs", headers={"Authorization": given}).status_code == 200


def test_the_probe_and_the_page_are_open_and_tell_nothing(guarded: World) -> None:
    assert guarded.client.get("/healthz").json() == {"status": "ok"}
    page = guarded.client.get(f"/jobs/{NOBODY}/view")
    assert (page.status_code, page.headers["content-type"]) == (200, "text/html; charset=utf-8")
    assert guarded.client.get("/static/js/app.js").status_code == guarded.client.get("/docs").status_code == 200


@pytest.mark.parametrize(
    ("settings", "addresses", "status"),
    [
        ({}, ("10.0.0.5", "[2001:db8::1]", "[::ffff:10.0.0.5]"), 401),
        ({}, ("127.0.0.1", "[::1]", "[::ffff:127.0.0.1]"), 200),
        ({"allow_unauthenticated": True}, ("10.0.0.5",), 200),
        ({"publish": "127.0.0.1:8080"}, ("10.0.0.5",), 200),
        ({"publish": "0.0.0.0:8080"}, ("10.0.0.5",), 401),
    ],
)
def test_without_tokens_only_loopback_is_served(
    worlds: Callable[..., World], settings: dict[str, Any], addresses: tuple[str, ...], status: int
) -> None:
    client = worlds(**settings).client
    for address in addresses:
        answer = client.get(f"http://{address}/jobs")
        assert answer.status_code == status, address
        if status == 401:
            assert_refused(answer, 401, "UNAUTHENTICATED")
        assert client.get(f"http://{address}/healthz").status_code == 200
