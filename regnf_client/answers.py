"""A service's answers: the document of a good one, the error of a refusal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, TypeVar

import httpx
from pydantic import BaseModel, ValidationError

from regnf_client.errors import ServiceError
from regnf_core.field_candidates import Candidate

_Model = TypeVar("_Model", bound=BaseModel)
HINTS = {  # in place of the service's own, which are of HTTP
    "UNAUTHENTICATED": "Give the service's token: token=..., --token, or the environment variable REGNF_API_TOKEN.",
    "RATE_LIMITED": "Wait a moment, and try again.",
    "TOO_MANY_WRITES": "Wait a moment, and try again.",
    "QUEUE_FULL": "Try again later.",
    "JOB_NOT_FOUND": "Look at the id: `client.jobs()` lists your jobs. Another caller's jobs are not shown.",
    "JOB_NOT_READY": "Wait for the job first: `client.wait(job)`.",
    "JOB_EXPIRED": "Register again: the service keeps results for a limited time.",
    "FIELD_NOT_FOUND": "Upload it first: `client.upload(path)`. Another caller's fields are not shown.",
    "ARTIFACT_NOT_FOUND": "The result's `artifacts` has the names of all files.",
}


def checked(answer: httpx.Response, hints: Mapping[str, str] = HINTS) -> dict[str, Any]:
    """The JSON object of a good answer; raises ServiceError for a refusal, and for what is no regnf service.

    hints: by reason, in place of the service's.
    """
    document = _object_of(answer)
    if answer.is_success and document is not None:
        return document
    raise refusal(answer, hints)


def parsed(model: type[_Model], values: Mapping[str, Any]) -> _Model:
    """A document of the service as a model. Raises ServiceError for one that has not what every regnf service says."""
    try:
        return model.model_validate(values)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        hint = "Client and service are of releases that differ too much, or the address is another service's."
        raise ServiceError(f"the answer is no {model.__name__}: {where}: {first['msg']}", hint=hint) from error


def refusal(answer: httpx.Response, hints: Mapping[str, str] = HINTS) -> ServiceError:
    """The error that an answer stands for."""
    document = _object_of(answer)
    if document is None or not (document.keys() & {"reason", "detail", "title"}):
        error = _no_regnf(answer)
    else:
        error = service_error(document, hints)
    error.status = answer.status_code
    error.unavailable = answer.status_code in (502, 503, 504)
    return error


def service_error(problem: Mapping[str, Any], hints: Mapping[str, str] = HINTS) -> ServiceError:
    """The error for a problem object. Its faults are told too, where the detail alone does not name them."""
    if problem.get("reason") == "JOB_FAILED" and isinstance(problem.get("error"), dict):
        problem = problem["error"]  # why the job failed says more than that it did
    detail = str(problem.get("detail") or problem.get("title") or "the service gave no detail")
    reason = str(problem.get("reason", ServiceError.reason))
    faults = [fault for fault in problem.get("errors") or [] if isinstance(fault, dict)]
    named = [f"{fault.get('pointer') or fault.get('parameter')}: {fault.get('detail')}" for fault in faults]
    if named and faults[0].get("detail") != detail:
        detail = f"{detail} {'; '.join(named)}"
    hint = hints.get(reason) or problem.get("hint")
    error = ServiceError(detail, reason=reason, hint=None if hint is None else str(hint))
    error.candidates = tuple(_candidates(problem.get("candidates")))
    offset = problem.get("offset")
    error.offset = offset if isinstance(offset, int) else None
    return error


def _object_of(answer: httpx.Response) -> dict[str, Any] | None:
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


def _no_regnf(answer: httpx.Response) -> ServiceError:
    url = answer.request.url
    message = f"HTTP status {answer.status_code} from {url.scheme}://{url.netloc.decode()}{url.path}: no regnf service"
    hint = "Check address and port: `regnf serve` prints them. A proxy in front must pass every path on."
    return ServiceError(message, hint=hint)
