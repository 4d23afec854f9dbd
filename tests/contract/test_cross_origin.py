"""Pages of other sites: none may call the service, unless the operator has named its site."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from regnf_service.http.hosts import HostsError, cors_origins
from regnf_state.settings import Settings
from tests.contract.world import World, assert_refused

APP = "https://app.example"
ASKING = {
    "Origin": APP,
    "Access-Control-Request-Method": "PUT",
    "Access-Control-Request-Headers": "authorization,content-type",
    "Sec-Fetch-Site": "cross-site",
    "Sec-Fetch-Mode": "cors",
}
CALLING = {"Origin": APP, "Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "cors"}


@pytest.fixture
def opened(worlds: Callable[..., World]) -> World:
    return worlds(cors_origins=frozenset({APP}), api_tokens=frozenset({"first-token"}))


def test_without_the_setting_no_site_may(world: World) -> None:
    answer = world.client.options("/fields", headers=ASKING)
    assert_refused(answer, 403, "ORIGIN_NOT_ALLOWED")
    assert "access-control-allow-origin" not in answer.headers


def test_a_named_site_is_told_that_it_may_and_reads_the_answers(opened: World) -> None:
    asked = opened.client.options("/fields", headers=ASKING)
    assert asked.status_code == 200
    assert asked.headers["access-control-allow-origin"] == APP
    assert "PUT" in asked.headers["access-control-allow-methods"]
    assert "access-control-allow-credentials" not in asked.headers
    token = {"Authorization": "Bearer first-token"}
    answer = opened.client.get("/fields", headers=CALLING | token)
    assert (answer.status_code, answer.headers["access-control-allow-origin"]) == (200, APP)
    assert "ETag" in answer.headers["access-control-expose-headers"]


def test_a_named_site_still_needs_the_token_and_reads_the_refusal(opened: World) -> None:
    answer = opened.client.get("/fields", headers=CALLING)
    assert_refused(answer, 401, "UNAUTHENTICATED")
    assert answer.headers["access-control-allow-origin"] == APP


@pytest.mark.parametrize(
    "origin",
    ["https://other.example", "http://app.example", "https://app.example:444", "https://app.example.evil", "null"],
)
def test_no_other_site_may(opened: World, origin: str) -> None:
    for headers in (ASKING, CALLING):
        answer = opened.client.request("GET", "/fields", headers=headers | {"Origin": origin})
        assert_refused(answer, 403, "ORIGIN_NOT_ALLOWED")
        assert "access-control-allow-origin" not in answer.headers


def test_a_named_site_does_not_make_another_host_known(opened: World) -> None:
    assert_refused(opened.client.get("/fields", headers=CALLING | {"Host": "evil.example"}), 421, "HOST_NOT_ALLOWED")


@pytest.mark.parametrize(
    "entry",
    ["*", "app.example", "https://app.example/", "https://*.example", "null", "HTTPS://App.example", "https://"],
)
def test_what_is_no_origin_is_refused_at_the_start(entry: str) -> None:
    with pytest.raises(HostsError, match="REGNF_CORS_ORIGINS"):
        cors_origins(Settings(cors_origins=frozenset({entry})))
