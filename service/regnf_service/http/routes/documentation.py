"""How routes say in the contract what they answer: refusals by their reasons, headers by their names."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from typing import Any, TypeVar

from fastapi import APIRouter

from regnf_service.http.problems import MEDIA_TYPE
from regnf_service.http.schemas.reading import reference
from regnf_service.http.schemas.results import ProblemDocument
from regnf_state.reasons import REASONS

_PROBLEM = reference(ProblemDocument)
JSON = "application/json"
_Endpoint = TypeVar("_Endpoint", bound=Callable[..., Any])


def get_and_head(
    router: APIRouter, path: str, *, summary: str, name: str | None = None, **how: Any
) -> Callable[[_Endpoint], _Endpoint]:
    """Declare an endpoint for GET, and for HEAD, which has GET's status and headers; servers leave its content out.
    name: of the operation, where it is not the endpoint's own."""

    def declare(endpoint: _Endpoint) -> _Endpoint:
        called = name or endpoint.__name__
        router.get(path, name=called, summary=summary, **how)(endpoint)
        alone = "head_" + called.removeprefix("get_")
        router.head(path, name=alone, summary=f"{summary}: headers only", operation_id=alone, **how)(endpoint)
        return endpoint

    return declare


def refusals(*reasons: str) -> dict[int | str, dict[str, Any]]:
    """The responses entry for these reasons, several in a word list, grouped by status."""
    by_status: dict[int, list[str]] = defaultdict(list)
    for reason in dict.fromkeys(" ".join(reasons).split()):
        by_status[REASONS[reason].status].append(reason)
    return {
        status: {
            "description": ", ".join(f"`{reason}`" for reason in names),
            "content": {MEDIA_TYPE: {"schema": _PROBLEM}},
        }
        for status, names in sorted(by_status.items())
    }


def header(description: str) -> dict[str, Any]:
    return {"description": description, "schema": {"type": "string"}}


def links(parameter: str, source: str, *operations: str, **fixed: str) -> dict[str, Any]:
    """What can be done next with what an answer names: operations whose ``parameter`` is ``source``, a JSON Pointer.

    ``fixed`` are further parameters, taken from the request's path by their names.
    """
    known = {name: f"$request.path.{place}" for name, place in fixed.items()}
    parameters = {parameter: f"$response.body#{source}"} | known
    return {operation: {"operationId": operation, "parameters": parameters} for operation in operations}


FIELD_LINKS = links("sha256", "/sha256", "get_field", "patch_field", "delete_field")
JOB_LINKS = links("id", "/id", "get_job", "job_events", "cancel_job", "get_result", "delete_job", "view")
BATCH_LINKS = links("id", "/id", "get_batch", "batch_results", "cancel_batch", "delete_batch")
FILE: dict[str, Any] = {"type": "string", "format": "binary", "minLength": 1}
NOT_MODIFIED: dict[str, Any] = {"description": "The document still has one of the given ETags."}
BINARY: dict[str, Any] = {"schema": {"type": "string", "format": "binary"}}
UPLOAD_REFUSALS = (
    "INVALID_HEADER INVALID_DIGEST DIGEST_MISMATCH UPLOAD_INCOMPLETE UPLOAD_TOO_LARGE UNSUPPORTED_MEDIA_TYPE "
    "FIELD_NOT_RECOGNIZED TOO_MANY_REQUESTS_AT_ONCE QUOTA_STORED QUOTA_ACTIVE_JOBS STORAGE_FULL"
)
PIECE_REFUSALS = "UPLOAD_NOT_FINISHED TOO_MANY_PIECES"
MULTIPART_REFUSALS = "MALFORMED_MULTIPART REQUEST_TOO_LARGE"
