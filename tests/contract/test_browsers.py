"""Other web pages: what a browser sends for them is refused, whatever they try, with tokens and without."""

from __future__ import annotations

from collections.abc import Callable

import anyio
import httpx
import pytest
from fastapi import FastAPI

from regnf_service.http.hosts import HostsError, cors_origins
from regnf_service.http.problems import SECURITY_HEADERS
from regnf_state.settings import Settings
from tests.contract.world import NOBODY, World, assert_refused

OWN = "http://localhost"
TOKEN = {"Authorization": "Bearer open-sesame-open-sesame"}
ORIGINS = (
    "http://evil.example", "null", "http://localhost:9999", "http://localhost.evil.example", "http://evil@localhost",
    "http://localhost/", "file://", "chrome-extension://localhost", "", f"{OWN} http://evil.example",
)  # fmt: skip
FOREIGN: list[dict[str, str]] = [
    *({"Origin": origin} for origin in ORIGINS),
    *({"Sec-Fetch-Site": site} for site in ("cross-site", "same-site", "anything")),
    {"Origin": OWN, "Sec-Fetch-Site": "cross-site"},
    {"Origin": "http://evil.example", "Sec-Fetch-Site": "same-origin"},
]
CALLS = [
    ("GET", "/fields"), ("GET", "/jobs"), ("GET", f"/jobs/{NOBODY}/artifacts/trace.json"), ("POST", "/register"),
    ("POST", "/fields"), ("PUT", f"/fields/{NOBODY * 2}"), ("DELETE", f"/fields/{NOBODY * 2}"),
    ("POST", f"/jobs/{NOBODY}/cancel"), ("POST", f"/v1/jobs/{NOBODY}/cancel"), ("OPTIONS", "/register"),
    ("GET", "/healthz"), ("GET", "/static/js/app.js"), ("GET", "/nowhere"),
]  # fmt: skip
STRANGERS = [
    "evil.example", "localhost.evil.example", "127.0.0.1.evil.example", "evil-localhost", "localhost.", "a@localhost",
    "localhost:80:80", "localhost:http", "localhost:0", "localhost:65536", "localhost:", "localhost,evil.example",
    "localhost/", "localhost#", "localhost evil.example", "127.1", "2130706433", "0x7f000001", "0177.0.0.1", "10.0.0.5",
    "[::1", "::1", "[::1%25eth0]", "[127.0.0.1]", "xn--lcalhost-abc", "", ":80", "*", "0.0.0.0", "[::]",
    "a" * 300, "evil.localhost", "service.internal",
]  # fmt: skip


LAB = {"api_tokens": frozenset({"lab:open-sesame-open-sesame"})}
Worlds = Callable[..., World]


@pytest.fixture(params=["without tokens", "with tokens"])
def browsed(request: pytest.FixtureRequest, worlds: Worlds) -> World:
    if request.param == "without tokens":
        return worlds()
    made = worlds(**LAB)
    made.client.headers.update(TOKEN)
    return made


def call(client: httpx.Client, method: str, path: str, **headers: str) -> httpx.Response:
    return client.request(method, path, headers=headers)


def test_nothing_is_done_for_a_page_of_another_site(browsed: World) -> None:
    for method, path in CALLS:
        for headers in FOREIGN:
            assert_refused(call(browsed.client, method, path, **headers), 403, "ORIGIN_NOT_ALLOWED")


def test_a_name_that_is_not_the_services_is_refused(browsed: World) -> None:
    forwarded = {"X-Forwarded-Host": "localhost", "Origin": OWN}
    for host in STRANGERS:
        for method, path in (("GET", "/fields"), ("POST", "/register"), ("DELETE", f"/fields/{NOBODY * 2}")):
            assert_refused(call(browsed.client, method, path, Host=host), 421, "HOST_NOT_ALLOWED")
        assert_refused(call(browsed.client, "GET", "/fields", Host=host, **forwarded), 421, "HOST_NOT_ALLOWED")
    for host in ("localhost", "LOCALHOST:8080", "127.0.0.1", "127.8.9.10:1", "[::1]", "[::ffff:127.0.0.1]:80"):
        assert call(browsed.client, "GET", "/fields", Host=host).status_code == 200, "loopback needs no list"


def test_two_hosts_or_none_and_web_sockets_are_refused(browsed: World) -> None:
    own = (b"host", b"localhost")
    for given in ([], [own, own]):
        assert bare_call(browsed.app, "/fields", given) == 421
    assert bare_call(browsed.app, "http://evil.example/fields", [own]) == 421
    assert bare_call(browsed.app, "/fields", [own], "websocket") == 1008


def bare_call(app: FastAPI, path: str, headers: list[tuple[bytes, bytes]], kind: str = "http") -> int:
    sent: list[dict[str, object]] = []

    async def receive() -> dict[str, object]:
        return {"type": "websocket.connect"} if kind == "websocket" else {"type": "http.request", "body": b""}

    async def send(message: dict[str, object]) -> None:
        sent.append(message)

    scope = {
        "type": kind, "asgi": {"version": "3.0"}, "http_version": "1.1", "method": "GET", "scheme": "http",
        "path": path, "raw_path": path.encode(), "query_string": b"", "root_path": "", "headers": [*headers, *AS_TOKEN],
        "client": ("127.0.0.1", 1), "server": ("127.0.0.1", 2), "subprotocols": [],
    }  # fmt: skip
    anyio.run(app, scope, receive, send)
    return int(sent[0].get("status") or sent[0]["code"])  # type: ignore[call-overload]


AS_TOKEN = [(b"authorization", TOKEN["Authorization"].encode())]


def test_the_operator_names_hosts(worlds: Worlds) -> None:
    client = worlds(
        allowed_hosts=frozenset({"Fields.example.org", "api:8080", "*.lab.example.org", "[2001:db8::1]"})
    ).client
    for host in ("fields.example.org:444", "api:8080", "a.b.lab.example.org", "[2001:DB8:0::1]:80"):
        assert call(client, "GET", "/fields", Host=host).status_code == 200, host
    for host in ("api", "api:80", "lab.example.org", "evillab.example.org", "x.fields.example.org"):
        assert_refused(call(client, "GET", "/fields", Host=host), 421, "HOST_NOT_ALLOWED")
    # a neighbor below the same domain, or behind another port, is another site
    for origin in ("https://b.lab.example.org", "https://fields.example.org", "https://a.lab.example.org:8443"):
        refused = call(client, "POST", "/register", Host="a.lab.example.org", Origin=origin)
        assert_refused(refused, 403, "ORIGIN_NOT_ALLOWED")
    own = call(client, "POST", "/register", Host="a.lab.example.org", Origin="https://a.lab.example.org")
    assert_refused(own, 415, "UNSUPPORTED_MEDIA_TYPE")


@pytest.mark.parametrize(
    ("settings", "host"),
    [
        ({"allowed_hosts": frozenset({"*"})}, "whatever.example"),
        ({"publish": "192.168.1.5:8080", **LAB}, "192.168.1.5:8080"),
        ({"host": "fields.lan", **LAB}, "fields.lan:8080"),
    ],
)
def test_where_it_was_told_to_listen_it_answers_and_says_nothing_of_origins(
    worlds: Worlds, settings: dict[str, object], host: str
) -> None:
    client = worlds(**settings).client
    assert call(client, "GET", "/fields", Host=host, **TOKEN).status_code == 200
    for origin in (f"http://{host.partition(':')[0]}:81", "http://evil.example"):
        refused = call(client, "GET", "/fields", Host=host, **TOKEN, Origin=origin)
        assert_refused(refused, 403, "ORIGIN_NOT_ALLOWED")


def test_the_page_itself_and_programs_go_on(world: World) -> None:
    job = world.submit()
    own = {"Sec-Fetch-Site": "same-origin", "Sec-Fetch-Mode": "cors"}
    assert call(world.client, "GET", f"/jobs/{job}", **own).status_code == 200
    assert call(world.client, "POST", f"/jobs/{job}/cancel", Origin=OWN, **own).status_code == 202


def test_a_link_leads_to_the_pages_and_to_nothing_else(world: World) -> None:
    job = world.submit()
    visit = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "document"}
    for path in (f"/jobs/{job}/view", f"/v1/jobs/{job}/view", "/docs"):
        assert call(world.client, "GET", path, **visit).status_code == 200
        framed = visit | {"Sec-Fetch-Dest": "iframe"}
        assert_refused(call(world.client, "GET", path, **framed), 403, "ORIGIN_NOT_ALLOWED")
    assert_refused(call(world.client, "GET", f"/jobs/{job}", **visit), 403, "ORIGIN_NOT_ALLOWED")
    assert_refused(call(world.client, "POST", f"/jobs/{job}/view", **visit), 403, "ORIGIN_NOT_ALLOWED")


def test_every_answer_has_its_headers(world: World) -> None:
    job = world.submit()
    world.succeed(job)
    paths = ["/", "/docs", "/healthz", "/nowhere", f"/jobs/{job}", f"/jobs/{job}/view", f"/jobs/{job}/result"]
    paths += ["/static/js/app.js", "/static/none", "/fields", "/fields?nothing=1", f"/jobs/{job}/artifacts/result.json"]
    answers = [world.client.get(path) for path in paths] + [call(world.client, "GET", "/jobs", Host="evil.example")]
    for answer in answers:
        policy = answer.headers["content-security-policy"]
        assert "frame-ancestors 'none'" in policy
        assert "unsafe" not in policy
        for name in SECURITY_HEADERS.keys() - {"Content-Security-Policy", "Cache-Control"}:
            assert answer.headers[name] == SECURITY_HEADERS[name], (answer.url, name)
        assert answer.headers.get_list("cache-control"), answer.url


def test_nothing_redirects_to_whatever_host_says(browsed: World) -> None:
    for path in ("/fields/", "/jobs/", "/docs/", "/static", "/v1", "/v1/", "//evil.example/..", "/static/../static"):
        answer = browsed.client.get(path)
        assert answer.status_code in (200, 404), path
        assert "location" not in answer.headers


# sites that the operator has named

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
def opened(worlds: Worlds) -> World:
    return worlds(cors_origins=frozenset({APP}), api_tokens=frozenset({"first-token"}))


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

    without = opened.client.get("/fields", headers=CALLING)
    assert_refused(without, 401, "UNAUTHENTICATED")
    assert without.headers["access-control-allow-origin"] == APP, "it reads the refusal too"
    assert_refused(opened.client.get("/fields", headers=CALLING | {"Host": "evil.example"}), 421, "HOST_NOT_ALLOWED")


def test_no_other_site_may(opened: World) -> None:
    for origin in [
        "https://other.example",
        "http://app.example",
        "https://app.example:444",
        "https://app.example.evil",
        "null",
    ]:
        for headers in (ASKING, CALLING):
            answer = opened.client.request("GET", "/fields", headers=headers | {"Origin": origin})
            assert_refused(answer, 403, "ORIGIN_NOT_ALLOWED")
            assert "access-control-allow-origin" not in answer.headers


def test_without_the_setting_no_site_may_and_it_takes_origins_alone(world: World) -> None:
    answer = world.client.options("/fields", headers=ASKING)
    assert_refused(answer, 403, "ORIGIN_NOT_ALLOWED")
    assert "access-control-allow-origin" not in answer.headers
    for entry in [
        "*",
        "app.example",
        "https://app.example/",
        "https://*.example",
        "null",
        "HTTPS://App.example",
        "https://",
    ]:
        with pytest.raises(HostsError, match="REGNF_CORS_ORIGINS"):
            cors_origins(Settings(cors_origins=frozenset({entry})))
