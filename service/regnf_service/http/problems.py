"""Problem details (RFC 9457): the one place where what went wrong becomes an HTTP answer.

No traceback and no input value ever leaves through here: clients get a stable reason, a sentence, and JSON Pointers.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from typing import Any

from fastapi import FastAPI
from fastapi.exceptions import RequestValidationError
from redis.exceptions import OutOfMemoryError, RedisError
from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse

from regnf_core.errors import RegnfError
from regnf_service.problem import RETRY_LATER, Problem
from regnf_state.blobs.base import StorageFullError
from regnf_state.reasons import REASONS
from regnf_state.record_store import NameTakenError
from regnf_state.records import QueueFullError, QuotaError, RecordError, RecordsFullError, UnreadableRecordError

# Which methods an address answers to, by the contract.


def allowed_methods(contract: dict[str, Any], path: str) -> list[str]:
    """The methods that a path answers to, below whatever prefix; none for one the contract does not know."""
    found = set()
    for template, operations in contract["paths"].items():
        pattern = re.sub(r"\\{[^}]+\\}", "[^/]+", re.escape(template))
        if re.fullmatch(f"(/v1)?{pattern}", path):
            found |= {method.upper() for method in operations}
    return sorted(found)


# Addresses that need no token: the liveness probe, and the pages, which ask for the token themselves.

OPEN_PATHS = re.compile(r"(/v1)?/(healthz|docs)|/static/.*|(/v1)?/jobs/[A-Za-z0-9_-]+/view")


# What every answer tells browsers: no other site may read it or show it in a frame, and its type is what it says.

_STRICT_POLICY = "default-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
_FIXED = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "X-Frame-Options": "DENY",
}
_UNLESS_SAID = {"Content-Security-Policy": _STRICT_POLICY, "Cache-Control": "no-store"}
"""Pages bring a policy of their own; what may be kept says so itself."""


def secure(headers: MutableHeaders) -> None:
    """Add what is missing."""
    for name, value in _FIXED.items():
        headers[name] = value
    for name, value in _UNLESS_SAID.items():
        headers.setdefault(name, value)


SECURITY_HEADERS = {**_FIXED, **_UNLESS_SAID}
"""For answers that are written without the framework."""


logger = logging.getLogger(__name__)
MEDIA_TYPE = "application/problem+json"
_PLAIN_PATH = re.compile(r"[A-Za-z0-9/_.-]{1,200}")
_RECORDS_FULL = "The job store is almost full, so new work is refused. Delete finished jobs, or retry later."
_STATUS_REASONS = {401: "UNAUTHENTICATED", 404: "NOT_FOUND", 405: "METHOD_NOT_ALLOWED", 413: "REQUEST_TOO_LARGE"}


def problem_of(error: Exception) -> Problem:
    """The problem of an exception. Any other exception is INTERNAL."""
    match error:
        case Problem():
            return error
        case RequestValidationError():
            return _query_problem(error)
        case HTTPException():
            reason = _STATUS_REASONS.get(error.status_code, "INTERNAL")
            return Problem(reason, headers=error.headers)
        case QueueFullError():
            return Problem("QUEUE_FULL", headers=RETRY_LATER)
        case QuotaError():
            return Problem(error.reason, headers=RETRY_LATER if REASONS[error.reason].status == 429 else None)
        case NameTakenError():
            return Problem(error.reason)
        case RecordsFullError() | OutOfMemoryError():
            return Problem("STORAGE_FULL", _RECORDS_FULL, headers=RETRY_LATER)
        case UnreadableRecordError():
            return Problem(error.reason, headers={"Retry-After": "60"})
        case RecordError():
            return Problem("CONFLICT")
        case RegnfError():
            return Problem(error.reason if error.reason in REASONS else "INVALID_REQUEST", str(error), hint=error.hint)
        case RedisError():
            return Problem("STORAGE_UNAVAILABLE", "The job store does not respond. Retry later.", headers=RETRY_LATER)
        case StorageFullError():
            return Problem("STORAGE_FULL", headers=RETRY_LATER)
        case FileNotFoundError():  # the store answers: what was there a moment ago has been deleted
            return Problem("NOT_FOUND")
        case OSError():
            return Problem("STORAGE_UNAVAILABLE", headers=RETRY_LATER)
        case _:
            return Problem("INTERNAL")


def _query_problem(error: RequestValidationError) -> Problem:
    """Parameters and headers that FastAPI refused: named by their own names, which are ours."""
    places = {str(entry["loc"][0]) for entry in error.errors()}
    if "path" in places:
        return Problem("NOT_FOUND")
    errors = [{"parameter": str(entry["loc"][-1]), "detail": str(entry["msg"])} for entry in error.errors()]
    return Problem("INVALID_HEADER" if places == {"header"} else "INVALID_QUERY", errors=errors)


def problem_response(problem: Problem, scope: Mapping[str, Any]) -> JSONResponse:
    """The answer to send, carrying the request's id in body and header."""
    request_id = scope.get("state", {}).get("request_id")
    headers = SECURITY_HEADERS | problem.headers  # an internal error is answered outside of the middleware
    if request_id is not None:
        headers["X-Request-ID"] = request_id
    if any(name == b"expect" for name, _ in scope.get("headers", ())):
        headers["Connection"] = "close"  # nobody knows whether the body still comes
    path = scope.get("path", "")
    instance = path if _PLAIN_PATH.fullmatch(path) else None  # never an echo of anything odd or long
    return JSONResponse(
        problem.document(instance, request_id), status_code=problem.status, headers=headers, media_type=MEDIA_TYPE
    )


async def _answer(request: Request, error: Exception) -> JSONResponse:
    problem = problem_of(error)
    request_id = getattr(request.state, "request_id", None)
    if problem.reason == "INTERNAL":
        # written outside of everything that gives entries their context
        told = {"request_id": request_id, "caller": getattr(request.state, "caller", None)}
        logger.error("%s request_id=%s", problem.reason, request_id, exc_info=error, extra=told)
    elif problem.reason.startswith("QUOTA_"):
        request.app.state.metrics.quota_refusals.labels(problem.reason).inc()
    elif isinstance(error, RedisError) and problem.status == 503:
        request.app.state.metrics.redis_errors.inc()
    if problem.reason != "INTERNAL" and problem.status >= 500:
        logger.warning("%s request_id=%s: %s", problem.reason, request_id, type(error).__name__)
    if problem.reason == "METHOD_NOT_ALLOWED":
        # the framework names the methods of the first route that fits, not of the address
        problem.headers["Allow"] = (
            ", ".join(allowed_methods(request.app.openapi(), request.scope["path"])) or "GET, HEAD"
        )
    return problem_response(problem, request.scope)


def install(app: FastAPI) -> None:
    """Make every exception of the app leave as a problem."""
    for kind in (
        Problem,
        RequestValidationError,
        HTTPException,
        RegnfError,
        RecordError,
        RedisError,
        OSError,
        Exception,
    ):
        app.add_exception_handler(kind, _answer)
