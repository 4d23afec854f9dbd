"""What the service says about itself, and the page."""

from __future__ import annotations

import re
from html.parser import HTMLParser

import pytest
from redis.exceptions import ConnectionError as RedisConnectionError

from regnf_core import __version__
from tests.contract.world import World, assert_refused


def test_health_and_version(world: World) -> None:
    assert world.client.get("/healthz").json() == {"status": "ok"}
    assert world.client.get("/version").json()["version"] == __version__


@pytest.mark.parametrize(
    "path", ["/", "/docs", "/healthz", "/readyz", "/version", "/openapi.yaml", "/openapi.json", "/v1/healthz"]
)
def test_what_is_said_of_the_service_answers_head(world: World, path: str) -> None:
    get, head = world.client.get(path), world.client.head(path)
    assert (head.status_code, head.content) == (200, b"")
    for name in ("content-type", "content-length"):
        assert head.headers[name] == get.headers[name]


def test_head_of_what_is_not_ready_is_refused_as_get_is(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(world.queue, "workers", 0)
    head = world.client.head("/readyz")
    assert (head.status_code, head.content) == (503, b"")
    assert "retry-after" in head.headers


def test_ready_when_everything_is_there(world: World) -> None:
    answer = world.client.get("/readyz").json()
    assert answer == {"status": "ready", "checks": {"records": True, "storage": True, "worker": True}}
    assert world.blobs.blobs == {}


@pytest.mark.parametrize("missing", ["records", "storage", "worker"])
def test_not_ready_when_something_is_missing(world: World, monkeypatch: pytest.MonkeyPatch, missing: str) -> None:
    def away() -> bool:
        raise RedisConnectionError("away")

    def broken() -> None:
        raise OSError("broken")

    with monkeypatch.context() as patch:
        patch.setattr(world.records, "probe", away if missing == "records" else lambda: None)
        if missing == "storage":
            patch.setattr(world.blobs, "probe", broken)
        patch.setattr(world.queue, "workers", 0 if missing == "worker" else 1)
        answer = world.client.get("/readyz")
    problem = assert_refused(answer, 503, "NOT_READY")
    assert [name for name, there in problem["checks"].items() if not there] == [missing]
    reasons = {"records": "STORAGE_UNAVAILABLE", "storage": "STORAGE_UNAVAILABLE", "worker": "NO_WORKER"}
    assert problem["reasons"] == {missing: reasons[missing]}


def test_the_index_names_every_address(world: World) -> None:
    contract = world.app.openapi()
    named = world.client.get("/").json()["addresses"]
    assert len(named) == sum(len(operations) for operations in contract["paths"].values())
    assert "POST /register" in named
    assert "POST /v1/register" in world.client.get("/v1/").json()["addresses"]


class Links(HTMLParser):
    """Collects every address that a page would load or lead to."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self.ids: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        self.found += [values[name] for name in ("src", "href", "action", "data") if name in values]
        self.ids |= {values["id"]} if "id" in values else set()


def test_the_documentation_loads_nothing_from_elsewhere(world: World) -> None:
    page = world.client.get("/docs")
    links = Links()
    links.feed(page.text)
    assert all(link.startswith(("#", "/")) for link in links.found)
    assert {link[1:] for link in links.found if link.startswith("#")} <= links.ids
    for address in links.found:
        assert address.startswith("#") or world.client.get(address).status_code == 200
    policy = page.headers["content-security-policy"]
    assert policy.startswith("default-src 'self';")
    assert "unsafe" not in policy


def test_the_contract_is_served_as_json_too(world: World) -> None:
    answer = world.client.get("/openapi.json")
    assert answer.headers["content-type"] == "application/json"
    assert answer.json() == world.app.openapi()
    assert answer.json()["x-reasons"]["QUEUE_FULL"]["status"] == 503


def test_the_page_of_a_job(world: World) -> None:
    job_id = world.submit()
    page = world.client.get(f"/jobs/{job_id}/view")
    assert page.status_code == 200
    policy = dict(part.split(" ", 1) for part in page.headers["content-security-policy"].split("; "))
    assert world.client.head(f"/jobs/{job_id}/view").headers["content-length"] == page.headers["content-length"]
    assert (policy["default-src"], policy["object-src"]) == ("'self'", "'none'")
    loaded = re.findall(r'(?:src|href)="(/static/[^"]+)"', page.text)
    assert loaded
    for address in loaded:
        assert world.client.get(address).status_code == 200
    assert_refused(world.client.get("/jobs/nobody/view"), 404, "JOB_NOT_FOUND")


def test_what_takes_requests_needs_no_worker(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(world.queue, "workers", 0)
    assert assert_refused(world.client.get("/readyz"), 503, "NOT_READY")["detail"] == "Missing: worker (NO_WORKER)."
    answer = world.client.get("/readyz", params={"worker": "false"})
    assert (answer.status_code, answer.json()["checks"]["worker"]) == (200, False)

    def refuse() -> None:
        raise RedisConnectionError("away")

    monkeypatch.setattr(world.records, "probe", refuse)
    answer = world.client.get("/readyz", params={"worker": "false"})
    assert assert_refused(answer, 503, "NOT_READY")["detail"] == "Missing: records (STORAGE_UNAVAILABLE)."
    assert_refused(world.client.get("/readyz", params={"worker": "maybe"}), 400, "INVALID_QUERY")
