"""A description after a change: RFC 7396, with what is wrong pointed at where the change has it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from regnf_core.importing.upload_description import UploadDescription
from regnf_service.http.schemas.reading import read_model
from regnf_service.problem import Problem
from regnf_state.records import FieldRecord


def described_anew(known: FieldRecord, change: Mapping[str, Any]) -> UploadDescription:
    """What is said of a field after a change as RFC 7396 has it. Raises Problem INVALID_DESCRIPTION."""
    merged = _merged(known.said, change)
    try:
        return read_model(UploadDescription, json.dumps(merged).encode(), "INVALID_DESCRIPTION")
    except Problem as problem:
        faults = [{**fault, "pointer": "/description" + fault.get("pointer", "")} for fault in problem.errors]
        raise Problem(problem.reason, problem.detail, errors=faults, hint=problem.hint) from problem


def _merged(held: Mapping[str, Any], change: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(held)
    for name, value in change.items():
        if value is None:
            merged.pop(name, None)
        elif isinstance(value, dict):
            inner = merged.get(name)
            merged[name] = _merged(inner if isinstance(inner, dict) else {}, value)
        else:
            merged[name] = value
    return merged
