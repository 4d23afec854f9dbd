"""Reading a JSON body as a schema, and saying what is wrong with it without repeating it."""

from __future__ import annotations

import json
from typing import TypeVar

from pydantic import TypeAdapter, ValidationError

from regnf_core.options import UNKNOWN_OPTION, did_you_mean
from regnf_service.http.problems import Problem, json_pointer
from regnf_service.http.schemas.detections import SPELLINGS as BOX_SPELLINGS
from regnf_service.http.schemas.registrations import SEARCH_UNSUPPORTED, START_UNSUPPORTED
from regnf_service.http.schemas.transforms import SPELLINGS as TRANSFORM_SPELLINGS
from regnf_service.http.strict_json import parse_json

_REASONS = {
    "detection": "INVALID_DETECTION",
    "options": "INVALID_OPTIONS",
    "initial_transform": "INVALID_TRANSFORM",
    "ground_truth": "INVALID_TRANSFORM",
    "webhook": "INVALID_WEBHOOK",
}
_REASONS_OF_FAULTS = {
    START_UNSUPPORTED: "INITIAL_TRANSFORM_UNSUPPORTED",
    SEARCH_UNSUPPORTED: "LIBRARY_SEARCH_UNSUPPORTED",
}
_SPELLINGS = BOX_SPELLINGS | TRANSFORM_SPELLINGS
_Model = TypeVar("_Model")


def read_model(model: type[_Model], body: bytes, otherwise: str = "INVALID_REQUEST") -> _Model:
    """The body as ``model``, a pydantic model or dataclass, strictly.

    Raises Problem: MALFORMED_JSON, the faulty member's reason, or ``otherwise``.
    """
    text = json.dumps(parse_json(body))
    try:
        return TypeAdapter(model).validate_json(text, strict=True)
    except ValidationError as error:
        raise refusal(error, otherwise) from error


def refusal(error: ValidationError, otherwise: str) -> Problem:
    """The problem for what a schema refused: the reason goes by the first faulty member, every fault is listed."""
    if any(fault["type"] == "json_invalid" for fault in error.errors(include_url=False, include_input=False)):
        return Problem("MALFORMED_JSON", "A string holds half of a surrogate pair.")
    faults = error.errors(include_url=False, include_input=False, include_context=False)
    places = [[part for part in fault["loc"] if part not in _SPELLINGS] for fault in faults]
    reasons = [
        _REASONS_OF_FAULTS.get(fault["type"]) or _REASONS.get(str(place[0]) if place else "")
        for fault, place in zip(faults, places, strict=True)
    ]
    reason = next(filter(None, reasons), otherwise)
    entries = [
        {"pointer": json_pointer(place), "detail": _detail(place, fault["type"], fault["msg"])}
        for place, fault in zip(places, faults, strict=True)
    ]
    return Problem(reason, errors=entries)


def _detail(place: list[str | int], kind: str, message: str) -> str:
    """The fault in words; for an unknown option, with the name that may have been meant."""
    unknown_option = kind == UNKNOWN_OPTION and place[0] == "options"
    return message.removeprefix("Value error, ") + (did_you_mean(place[1:]) if unknown_option else "")
