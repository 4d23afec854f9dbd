"""What a service answers when it refuses, as errors with the next step."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import httpx

from regnf_core.errors import InvalidInputError, RegnfError
from regnf_core.field_candidates import Candidate, Said

_HINTS = {
    "UNAUTHENTICATED": "Give the service's token with --token, or in the environment variable REGNF_API_TOKEN.",
    "RATE_LIMITED": "Wait a moment, and give the same command again.",
    "TOO_MANY_WRITES": "Wait a moment, and give the same command again.",
    "QUEUE_FULL": "Give the same command again later.",
}
_HOST = re.compile(r"[A-Za-z0-9.-]+(:\d+)?(/.*)?")


class ServiceError(RegnfError):
    """The service refused, or could not do, what was asked; ``reason`` is the one it gave."""

    reason = "SERVICE_ERROR"
    unavailable = False
    """Whether asking again later may help: the service is up but cannot take work now."""
    candidates: tuple[Candidate, ...] = ()
    """What a refused field may be."""
    said: Said | None = None
    """What the user said of that field."""


class UnreachableError(RegnfError):
    """Nothing answers at the service's address."""

    reason = "SERVICE_UNAVAILABLE"
    unavailable = True


def checked_address(address: str) -> httpx.URL:
    """The address of a service. Raises InvalidInputError (INVALID_ADDRESS)."""
    try:
        url = httpx.URL(address)
    except httpx.InvalidURL as error:
        raise InvalidInputError(f"{address}: {error}", reason="INVALID_ADDRESS", hint=_address_hint(address)) from error
    if url.scheme not in ("http", "https") or not url.host:
        message = f"{address!r} is no http:// or https:// address"
        raise InvalidInputError(message, reason="INVALID_ADDRESS", hint=_address_hint(address))
    return url


def unreachable(address: str, error: httpx.RequestError) -> UnreachableError:
    """The error for a service that does not answer."""
    hint = "Is it running? `regnf serve` starts one and prints its address; without --server the work is done here."
    return UnreachableError(f"{address} does not answer: {error}", hint=hint)


def checked(response: httpx.Response) -> dict[str, Any]:
    """The JSON object of a good answer; raises ServiceError for a refusal, and for what is no regnf service."""
    try:
        document = response.json()
    except ValueError:
        document = None
    if response.is_success and isinstance(document, dict):
        return document
    if not isinstance(document, dict) or not (document.keys() & {"reason", "detail", "title"}):
        error = _no_regnf(response)
    else:
        error = service_error(document)
    error.unavailable = response.status_code in (502, 503, 504)
    raise error


def service_error(problem: dict[str, Any]) -> ServiceError:
    """The error for a problem object. Its faults are told too, where the detail alone does not name them."""
    if problem.get("reason") == "JOB_FAILED" and isinstance(problem.get("error"), dict):
        problem = problem["error"]  # why the job failed says more than that it did
    detail = str(problem.get("detail") or problem.get("title") or "the service gave no detail")
    reason = str(problem.get("reason", ServiceError.reason))
    faults = [fault for fault in problem.get("errors") or [] if isinstance(fault, dict)]
    named = [f"{fault.get('pointer') or fault.get('parameter')}: {fault.get('detail')}" for fault in faults]
    if named and faults[0].get("detail") != detail:
        detail = f"{detail} {'; '.join(named)}"
    hint = problem.get("hint") or _HINTS.get(reason)
    error = ServiceError(detail, reason=reason, hint=None if hint is None else str(hint))
    error.candidates = tuple(_candidates(problem.get("candidates")))
    return error


def _candidates(values: Any) -> Iterator[Candidate]:
    for value in values if isinstance(values, list) else []:
        match value:
            case {"name": str() as name, "description": dict() as said}:
                yield Candidate(name, said)


def _no_regnf(response: httpx.Response) -> ServiceError:
    url = response.request.url
    message = (
        f"HTTP status {response.status_code} from {url.scheme}://{url.netloc.decode()}{url.path}: no regnf service"
    )
    hint = "Check address and port: `regnf serve` prints them. A proxy in front must pass every path on."
    return ServiceError(message, hint=hint)


def _address_hint(address: str) -> str:
    if _HOST.fullmatch(address):
        return f"Did you mean http://{address}?"
    return "Write the address that `regnf serve` prints, for example http://127.0.0.1:8080."
