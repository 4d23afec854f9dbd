"""Problems as bytes, for connections that never become a request of the application."""

from __future__ import annotations

import json
from functools import cache
from http import HTTPStatus

from regnf_service.http.problems import MEDIA_TYPE
from regnf_service.http.security_headers import SECURITY_HEADERS
from regnf_service.problem import RETRY_LATER, Problem

_RETRY_STATUSES = (408, 503)


@cache
def raw_answer(reason: str) -> bytes:
    """A whole answer after which the connection ends."""
    problem = Problem(reason)
    body = json.dumps(problem.document()).encode()
    headers = {"Content-Type": MEDIA_TYPE, "Content-Length": str(len(body)), "Connection": "close", **SECURITY_HEADERS}
    if problem.status in _RETRY_STATUSES:
        headers |= RETRY_LATER
    lines = [f"HTTP/1.1 {problem.status} {HTTPStatus(problem.status).phrase}"]
    lines += [f"{name}: {value}" for name, value in headers.items()]
    return "\r\n".join([*lines, "", ""]).encode() + body
