"""Hostile HTTP requests as bytes: a sound request to one of the routes, with random faults in any part of it."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random
from typing import Any

from benchmarks.attacks.bad_json import bad_body

_METHODS = ("GET", "HEAD", "POST", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "CONNECT", "get", "PRI", "G" * 300)
_FOREIGN_HOSTS = (
    "evil.example",
    "evil.example:80",
    "localhost.evil.example",
    "127.0.0.1.evil.example",
    "127.0.0.1@evil.example",
    "evil.example#127.0.0.1",
    "0x7f.1.evil.example",
    "[::1].evil.example",
    "169.254.169.254",
    "10.0.0.1",
    "xn--evil-9oa.example",
)
_FOREIGN_ORIGINS = (
    "http://evil.example",
    "https://evil.example:8443",
    "null",
    "http://localhost.evil.example",
    "file://",
)
_ODD_VALUES = (
    "",
    " ",
    "-1",
    "0",
    "1e309",
    "9" * 400,
    "nan",
    "%00",
    "../../etc/passwd",
    "..%2f..%2f",
    "a" * 9000,
    "\x85",
    "\u2028",
    "é".encode().decode("latin-1"),
    "*",
    '"',
    "'; DROP TABLE jobs--",
    "bytes=0-0,1-1,2-2",
    "${jndi:x}",
    "\r",
    "0x10",
    "+1",
)
_HEADERS = (
    "Range",
    "If-Range",
    "If-None-Match",
    "Prefer",
    "Idempotency-Key",
    "Content-Digest",
    "Last-Event-ID",
    "Accept",
    "Accept-Encoding",
    "Content-Encoding",
    "X-Request-ID",
    "Authorization",
    "Cookie",
    "Expect",
    "Upgrade",
    "Connection",
    "X-Forwarded-Host",
    "X-Forwarded-For",
    "X-Forwarded-Proto",
    "Forwarded",
    "X-HTTP-Method-Override",
    "X-Original-URL",
    "Sec-Fetch-Mode",
    "Origin",
    "Host",
    "Transfer-Encoding",
    "Content-Length",
)
_QUERIES = ("wait", "limit", "page_token", "label", "status", "worker", "dry_run", "unknown")
_ROUTES = (
    ("GET", "/fields"),
    ("POST", "/fields"),
    ("PUT", "/fields/{sha}"),
    ("GET", "/fields/{sha}"),
    ("DELETE", "/fields/{sha}"),
    ("GET", "/fields/{sha}/preview.png"),
    ("POST", "/register"),
    ("POST", "/register"),
    ("POST", "/register"),
    ("GET", "/jobs"),
    ("GET", "/jobs/{job}"),
    ("DELETE", "/jobs/{job}"),
    ("GET", "/jobs/{job}/result"),
    ("POST", "/jobs/{job}/cancel"),
    ("GET", "/jobs/{job}/artifacts/{name}"),
    ("GET", "/jobs/{job}/view"),
    ("GET", "/healthz"),
    ("GET", "/readyz"),
    ("GET", "/version"),
    ("GET", "/"),
    ("GET", "/openapi.yaml"),
    ("GET", "/docs"),
    ("GET", "/static/{name}"),
)


@dataclass(frozen=True)
class Known:
    """What the attacker knows: another caller's names, a token of its own ("" for none), and a sound request."""

    job: str
    fields: tuple[str, ...]
    token: str
    request: dict[str, Any]
    authority: str


@dataclass
class RawRequest:
    """One request. ``foreign``: it comes from another site, by its Host or its Origin, and must not be served."""

    method: str
    target: str
    headers: list[tuple[str, str]]
    body: bytes
    foreign: bool = False
    faults: list[str] = field(default_factory=list)

    def encode(self) -> bytes:
        lines = [f"{self.method} {self.target} HTTP/1.1", *(f"{name}: {value}" for name, value in self.headers)]
        return "\r\n".join(lines).encode("latin-1", "replace") + b"\r\n\r\n" + self.body


def draw(random: Random, known: Known) -> RawRequest:
    """A request with up to four faults; some have none but a foreign Host or Origin."""
    method, pattern = random.choice(_ROUTES)
    values = {
        "sha": random.choice([*known.fields, random.randbytes(32).hex()]),
        "job": random.choice([known.job, random.randbytes(16).hex()]),
        "name": random.choice(["result.json", "scene.ply", "app.js", "..%2f..%2fsettings.py", "%2e%2e/x"]),
    }
    made = RawRequest(
        method,
        pattern.format(**values),
        [("Host", known.authority), ("Connection", "close")],
        _body(random, method, known),
    )
    if known.token:
        made.headers.append(("Authorization", f"Bearer {known.token}"))
    if made.body:
        made.headers.append(("Content-Type", "application/json"))
        made.headers.append(("Content-Length", str(len(made.body))))
    for fault in random.sample(_FAULTS, random.choices(range(5), (15, 40, 30, 10, 5))[0]):
        fault(random, made)
        made.faults.append(fault.__name__.strip("_"))
    return made


def _body(random: Random, method: str, known: Known) -> bytes:
    if method not in ("POST", "PUT"):
        return b""
    if random.random() < 0.5:
        return json.dumps(known.request | {"seed": random.randrange(1 << 32)}).encode()
    return bad_body(random, known.request)


def _foreign_host(random: Random, made: RawRequest) -> None:
    made.headers = [(n, v) for n, v in made.headers if n != "Host"] + [("Host", random.choice(_FOREIGN_HOSTS))]
    made.foreign = True


def _foreign_origin(random: Random, made: RawRequest) -> None:
    made.headers.append(("Origin", random.choice(_FOREIGN_ORIGINS)))
    made.foreign = made.foreign or made.method not in ("GET", "HEAD", "OPTIONS", "TRACE")


def _fetch_site(random: Random, made: RawRequest) -> None:
    made.headers.append(("Sec-Fetch-Site", random.choice(["cross-site", "same-site"])))
    made.foreign = made.foreign or made.method not in ("GET", "HEAD", "OPTIONS", "TRACE")


def _method(random: Random, made: RawRequest) -> None:
    made.method = random.choice(_METHODS)
    made.foreign = False  # another method may be one that changes nothing


def _content_type(random: Random, made: RawRequest) -> None:
    kinds = ("text/plain", "application/x-www-form-urlencoded", "multipart/form-data; boundary=x", "a/b; c=\x00", "")
    made.headers.append(("Content-Type", random.choice(kinds)))


def _odd_header(random: Random, made: RawRequest) -> None:
    made.headers.append((random.choice(_HEADERS), random.choice(_ODD_VALUES)))


def _many_headers(random: Random, made: RawRequest) -> None:
    made.headers += [(f"X-{n}", "v") for n in range(random.choice([50, 200, 3000]))]


def _query(random: Random, made: RawRequest) -> None:
    pairs = [f"{random.choice(_QUERIES)}={random.choice(_ODD_VALUES)}" for _ in range(random.choice([1, 3, 500]))]
    made.target += "?" + "&".join(pairs).replace(" ", "+")


def _target(random: Random, made: RawRequest) -> None:
    odd: list[Callable[[str], str]] = [
        lambda t: t + "/",
        lambda t: "/" + t,
        lambda t: "/v1" + t,
        lambda t: t.replace("/", "/./", 1),
        lambda t: t + "%00",
        lambda t: t + "/../" * 40,
        lambda t: "http://evil.example" + t,
        lambda t: "//evil.example" + t,
        lambda t: "*",
        lambda t: t + "a" * 70000,
        lambda t: t + "%ff%fe",
        lambda t: t.upper(),
    ]
    made.target = random.choice(odd)(made.target)


def _lengths(random: Random, made: RawRequest) -> None:
    kinds = [
        [("Content-Length", "5"), ("Content-Length", "6")],
        [("Transfer-Encoding", "chunked"), ("Content-Length", "3")],
        [("Transfer-Encoding", "chunked, identity")],
        [("Transfer-Encoding", "xchunked")],
        [("Content-Length", "-1")],
        [("Content-Length", "99999999999999999999")],
        [("Content-Length", "1_0")],
    ]
    made.headers = [(n, v) for n, v in made.headers if n != "Content-Length"] + random.choice(kinds)


def _chunks(random: Random, made: RawRequest) -> None:
    made.headers = [(n, v) for n, v in made.headers if n != "Content-Length"] + [("Transfer-Encoding", "chunked")]
    size = random.choice(["5", "FFFFFFFFFFFFFFFFF", "-1", "0x5", "5;ext=" + "a" * 20000, "zz"])
    made.body = (
        f"{size}\r\n".encode() + made.body[:64] + random.choice([b"\r\n0\r\n\r\n", b"", b"\r\n0\r\nX: y\r\n\r\n"])
    )


def _raw_bytes(random: Random, made: RawRequest) -> None:
    made.headers.append((f"X-{random.choice(['a b', 'é', 'a:', ''])}", random.randbytes(8).decode("latin-1")))


def _truncated(random: Random, made: RawRequest) -> None:
    made.body = made.body[: random.randrange(len(made.body) + 1)]


_FAULTS: list[Callable[[Random, RawRequest], None]] = [
    _foreign_host,
    _foreign_origin,
    _fetch_site,
    _method,
    _content_type,
    _odd_header,
    _odd_header,
    _many_headers,
    _query,
    _target,
    _lengths,
    _chunks,
    _raw_bytes,
    _truncated,
]
