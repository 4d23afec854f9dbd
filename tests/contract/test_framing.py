"""Requests whose end two parties may see at different places: refused, so that no proxy in front can be misled."""

from __future__ import annotations

import pytest

from tests.contract.live import Live

pytestmark = pytest.mark.xdist_group("live api")
HIDDEN = b"GET /version HTTP/1.1\r\nHost: localhost\r\n\r\n"
BODY = b"0\r\n\r\n" + HIDDEN


@pytest.mark.parametrize(
    "head",
    [
        b"GET /healthz HTTP/1.1\r\nTransfer-Encoding: chunked\r\nContent-Length: %d\r\n" % len(BODY),
        b"GET /healthz HTTP/1.1\r\nContent-Length: %d\r\nTransfer-Encoding: Chunked\r\n" % len(BODY),
        b"POST /register HTTP/1.1\r\nContent-Length: 0\r\nTransfer-Encoding: chunked\r\n",
    ],
)
def test_a_body_with_two_lengths_is_refused_and_nothing_after_it_is_read(live: Live, head: bytes) -> None:
    with live.connect() as connection:
        connection.settimeout(20)
        connection.sendall(head + b"Host: localhost\r\n\r\n" + BODY)
        text = b""
        while data := connection.recv(65536):
            text += data
    assert text.startswith(b"HTTP/1.1 400 ")
    assert text.count(b"HTTP/1.1 ") == 1
    assert b"INVALID_HEADER" in text
