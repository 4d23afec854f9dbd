"""Responses of a service: the document of a success, the error of a refusal."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any, TypeVar

import httpx
from pydantic import BaseModel, ValidationError

from regnf_core.errors import Candidate, InvalidInputError, RegnfError, Said

# What goes wrong with a service, each with its ``reason`` and a ``hint``.
#
# RegnfError ├── InvalidInputError INVALID_ADDRESS, INVALID_TOKEN, FILE_NOT_FOUND ...: refused here, nothing was sent
# ├── ServiceError the service refused; ``status`` is that of HTTP ├── UnreachableError nothing answers, again and
# again ├── NoWorkerError no worker takes the job └── WaitTimeoutError the time that the caller gave is over; the job
# goes on

_HOST = re.compile(r"[A-Za-z0-9.-]+(:\d+)?(/.*)?")


class ServiceError(RegnfError):
    """The service refused the request, or could not do it; ``reason`` is the service's."""

    reason = "SERVICE_ERROR"
    status: int | None = None
    """The HTTP status; None if the request was refused before it was sent."""
    unavailable = False
    """Whether a later retry may help: the service runs, but cannot accept work at the moment."""
    candidates: tuple[Candidate, ...] = ()
    """The possible readings of a refused field."""
    said: Said | None = None
    """The import options of that field."""
    offset: int | None = None
    """Number of bytes of an upload that have arrived."""

    def told(self, message: str) -> ServiceError:
        """The same error with another message."""
        error = ServiceError(message, reason=self.reason, hint=self.hint)
        error.status, error.unavailable = self.status, self.unavailable
        error.candidates, error.said, error.offset = self.candidates, self.said, self.offset
        return error


class UnreachableError(RegnfError):
    """There is no response from the service's address."""

    reason = "SERVICE_UNAVAILABLE"
    unavailable = True


class NoWorkerError(RegnfError):
    """The service had no live worker within the caller's time limit."""

    reason = "NO_WORKER"
    unavailable = True


class WaitTimeoutError(RegnfError):
    """The job or the import of a field did not finish within the caller's time limit."""

    reason = "WAIT_TIMEOUT"
    unavailable = True


def checked_address(address: str) -> httpx.URL:
    """The address of a service. Raises InvalidInputError (INVALID_ADDRESS)."""
    try:
        url = httpx.URL(address)
    except (httpx.InvalidURL, TypeError) as error:
        message = f"{address}: {error}"
        raise InvalidInputError(message, reason="INVALID_ADDRESS", hint=_address_hint(str(address))) from error
    if url.scheme not in ("http", "https") or not url.host:
        message = f"{address!r} is no http:// or https:// address"
        raise InvalidInputError(message, reason="INVALID_ADDRESS", hint=_address_hint(address))
    return url


def checked_token(token: str) -> str:
    """A token, checked for use in a header. Raises InvalidInputError (INVALID_TOKEN)."""
    if token.isascii() and token.isprintable() and " " not in token and token:
        return token
    hint = "Give only the token, exactly as the operator gave it: without `Bearer`, quotes and line breaks."
    raise InvalidInputError("the token has invalid characters", reason="INVALID_TOKEN", hint=hint)


def unreachable(error: httpx.RequestError) -> UnreachableError:
    """The error for a service that does not answer."""
    url = error.request.url
    hint = "Check that the service is running. `regnf serve` starts one and prints its address."
    return UnreachableError(f"{url.scheme}://{url.netloc.decode()} does not answer: {error}", hint=hint)


def _address_hint(address: str) -> str:
    if _HOST.fullmatch(address):
        return f"Did you mean http://{address}?"
    return "Write the address that `regnf serve` prints, for example http://127.0.0.1:8080."


_Model = TypeVar("_Model", bound=BaseModel)
_HINTS = {  # in place of the service's own, which are of HTTP
    "UNAUTHENTICATED": "Give the service's token: token=..., --token, or the environment variable REGNF_API_TOKEN.",
    "RATE_LIMITED": "Wait a moment, and try again.",
    "QUEUE_FULL": "Try again later.",
    "JOB_NOT_FOUND": "Check the id: `client.jobs()` lists your jobs. Jobs of other callers are not shown.",
    "JOB_NOT_READY": "Wait for the job first: `client.wait(job)`.",
    "JOB_EXPIRED": "Register again: the service keeps results for a limited time.",
    "FIELD_NOT_FOUND": "Upload it first: `client.upload(path)`. Fields of other callers are not shown.",
    "ARTIFACT_NOT_FOUND": "`artifacts` of the result has the names of all files.",
}


def checked(answer: httpx.Response) -> dict[str, Any]:
    """The JSON object of a successful response. Raises ServiceError for a refusal, and if the address is not a regnf
    service."""
    document = object_of(answer)
    if answer.is_success and document is not None:
        return document
    raise refusal(answer)


def parsed(model: type[_Model], values: Mapping[str, Any]) -> _Model:
    """A document of the service, parsed into a model. Raises ServiceError if required members are missing."""
    try:
        return model.model_validate(values)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        hint = "The releases of client and service differ too much, or this is the address of another service."
        raise ServiceError(
            f"the response is not a valid {model.__name__}: {where}: {first['msg']}", hint=hint
        ) from error


def refusal(answer: httpx.Response) -> ServiceError:
    """The error of a response."""
    document = object_of(answer)
    if document is None or not (document.keys() & {"reason", "detail", "title"}):
        url = answer.request.url
        place = f"{url.scheme}://{url.netloc.decode()}{url.path}"
        hint = "Check address and port: `regnf serve` prints them. A proxy must forward all paths."
        error = ServiceError(f"HTTP status {answer.status_code} from {place}: this is no regnf service", hint=hint)
    else:
        error = service_error(document)
    error.status = answer.status_code
    error.unavailable = answer.status_code in (502, 503, 504)
    return error


def service_error(problem: Mapping[str, Any]) -> ServiceError:
    """The error for a problem object. Its faults are added, if the detail does not name them."""
    if problem.get("reason") == "JOB_FAILED" and isinstance(problem.get("error"), dict):
        problem = problem["error"]  # why the job failed says more than that it did
    detail = str(problem.get("detail") or problem.get("title") or "the service gave no detail")
    reason = str(problem.get("reason", ServiceError.reason))
    faults = [fault for fault in problem.get("errors") or [] if isinstance(fault, dict)]
    named = [f"{fault.get('pointer') or fault.get('parameter')}: {fault.get('detail')}" for fault in faults]
    if named and faults[0].get("detail") != detail:
        detail = f"{detail} {'; '.join(named)}"
    hint = _HINTS.get(reason) or problem.get("hint")
    error = ServiceError(detail, reason=reason, hint=None if hint is None else str(hint))
    error.candidates = tuple(_candidates(problem.get("candidates")))
    offset = problem.get("offset")
    error.offset = offset if isinstance(offset, int) else None
    return error


def object_of(answer: httpx.Response) -> dict[str, Any] | None:
    """The JSON object of an answer; None for anything else."""
    try:
        document = answer.json()
    except ValueError:
        return None
    return document if isinstance(document, dict) else None


def _candidates(values: Any) -> Iterator[Candidate]:
    for value in values if isinstance(values, list) else []:
        match value:
            case {"name": str() as name, "description": dict() as said}:
                yield Candidate(name, said)
