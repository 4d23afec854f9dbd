"""Which refusals a request that fits every schema may meet: those that no schema can say."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

CHECKED_STATUSES = frozenset({400, 415, 422})
"""Where a reason is looked at. Other statuses, such as 404 and 409, say by themselves that the state is meant."""
OF_STATE = frozenset(
    {
        "FIELD_REJECTED",  # which fields there are
        "FIELD_NOT_RECOGNIZED",  # what a file's bytes say
        "DIGEST_MISMATCH",
        "DETECTION_OUTSIDE_SCENE",  # what a field is of
        "LIBRARY_EMPTY",  # which entries there are
        "LIBRARY_TOO_LARGE",
        "EDIT_INVALID",  # which jobs there are
        "IDEMPOTENCY_KEY_REUSED",  # what was asked before
        "WEBHOOK_NOT_ALLOWED",  # the operator's settings
        "OPTIONS_TOO_COSTLY",
        "RENDER_TOO_LARGE",
    }
)
"""Reasons that depend on what the service holds, and on its settings: allowed wherever the contract documents them."""

_LISTS = ("jobs", "fields", "recordings", "batches", "library")
OF_MEMBERS: Mapping[str, frozenset[str]] = {
    **{f"GET /{name}": frozenset({"INVALID_QUERY"}) for name in _LISTS},  # a page token that no page has given
    "POST /register": frozenset(
        {
            "INVALID_DETECTION",  # min below max, a quaternion that is not zero
            "INVALID_TRANSFORM",  # a matrix with a rotation in it
            "INVALID_OPTIONS",  # a least scale above the largest
            "PRESET_UNSUITABLE",  # members that exclude one another
            "INVALID_REQUEST",
            "INVALID_DESCRIPTION",
        }
    ),
    "POST /render": frozenset(
        {
            "INVALID_DETECTION",
            "INVALID_TRANSFORM",
            "CAMERA_INVALID",  # a camera at its own target, a transforms.json that is none
            "EDIT_INVALID",
            "INVALID_REQUEST",  # members that exclude one another
        }
    ),
    "POST /fields": frozenset({"INVALID_DESCRIPTION", "MALFORMED_MULTIPART"}),  # `file` and `upload` at once
    "PATCH /fields/{sha256}": frozenset({"INVALID_DESCRIPTION"}),  # corners of bounds, a matrix
    "POST /library": frozenset({"INVALID_REQUEST"}),  # a continuous symmetry without an axis, an axis of length 0
    "PATCH /library/{name}": frozenset({"INVALID_REQUEST"}),  # or such a one together with
    # what the entry has
    "PUT /fields/{sha256}": frozenset({"INVALID_HEADER", "UPLOAD_INCOMPLETE"}),  # Content-Range against the body
}
"""Reasons that depend on several members or on their numbers together, by operation."""


def documented(contract: Mapping[str, Any], operation: str) -> frozenset[str]:
    """Every reason that the contract's responses name for an operation, such as ``POST /fields``."""
    method, path = operation.split(" ", 1)
    responses = contract["paths"][path][method.lower()]["responses"]
    named = [response.get("description", "").split("`")[1::2] for response in responses.values()]
    return frozenset(reason for reasons in named for reason in reasons)


def headers_fit(contract: Mapping[str, Any], operation: str, headers: Mapping[str, Any]) -> bool:
    """Whether every header has its pattern; schemathesis's coverage phase takes empty headers for such."""
    method, path = operation.split(" ", 1)
    patterns = {
        parameter["name"].lower(): parameter["schema"].get("pattern", "")
        for parameter in contract["paths"][path][method.lower()].get("parameters", ())
        if parameter["in"] == "header"
    }
    return all(re.search(patterns.get(name.lower(), ""), str(value)) for name, value in headers.items())


def beyond_schemas(contract: Mapping[str, Any], operation: str) -> frozenset[str]:
    """The reasons for which the operation may refuse what fits its schemas."""
    return documented(contract, operation) & OF_STATE | OF_MEMBERS.get(operation, frozenset())
