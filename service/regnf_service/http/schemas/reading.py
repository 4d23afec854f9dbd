"""Reading a JSON body as a schema, and saying what is wrong with it: where, what was expected, what to do next."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from functools import cache
from typing import Any, NamedTuple, TypeVar, cast

from pydantic import TypeAdapter, ValidationError

from regnf_core.errors import suggestion
from regnf_core.options import UNKNOWN_OPTION, did_you_mean
from regnf_service.http.schemas.detections import DETECTION_FAULT
from regnf_service.http.schemas.library import BY_DIGEST, BY_LIBRARY
from regnf_service.http.schemas.registrations import PRESET_FAULT
from regnf_service.http.schemas.registrations import SPELLINGS as TRANSFORM_SPELLINGS
from regnf_service.http.schemas.scenes import KINDS as EDIT_KINDS
from regnf_service.http.strict_json import MOST_VALUES, parse_json
from regnf_service.problem import MAX_ERRORS, Problem, json_pointer

# Which members a schema knows at a place, to name the one that was meant.


def members_at(model: Any, place: Sequence[str | int]) -> set[str]:
    """The names of the members that ``model`` takes at ``place``, the members' names and list indices from the top."""
    schema = _schema_of(model)
    found = [schema]
    for part in place:
        found = [below for node in found for below in _below(schema, node, part)]
    return {name for node in found for variant in _variants(schema, node) for name in variant.get("properties", {})}


@cache
def _schema_of(model: Any) -> dict[str, Any]:
    return TypeAdapter(model).json_schema()


def _below(schema: dict[str, Any], node: dict[str, Any], part: str | int) -> Iterator[dict[str, Any]]:
    for variant in _variants(schema, node):
        below = variant.get("items") if isinstance(part, int) else variant.get("properties", {}).get(part)
        if isinstance(below, dict):
            yield below


def _variants(schema: dict[str, Any], node: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """The node itself, what it refers to, and what it is a choice of."""
    if reference := node.get("$ref"):
        yield from _variants(schema, schema["$defs"][reference.rsplit("/", 1)[1]])
    for choice in (*node.get("anyOf", ()), *node.get("oneOf", ())):
        yield from _variants(schema, choice)
    yield node


_REASONS = {
    "detection": "INVALID_DETECTION",
    "options": "INVALID_OPTIONS",
    "initial_transform": "INVALID_TRANSFORM",
    "ground_truth": "INVALID_TRANSFORM",
    "edits": "EDIT_INVALID",
    **dict.fromkeys(("orbit", "look_at", "poses", "transforms", "size"), "CAMERA_INVALID"),
}
_REASONS_WITHIN = {
    "T_object_scene": "INVALID_TRANSFORM",
    "T_scene_object": "INVALID_TRANSFORM",
    "T_replacement_object": "INVALID_TRANSFORM",
    "T_scene_file": "INVALID_TRANSFORM",
    "detection": "INVALID_DETECTION",
}
"""Of members that lie deeper: they go before those of the whole."""
_FIELDS = frozenset({"scene", "object", "candidates", "replacement"})
_TAGS = TRANSFORM_SPELLINGS | EDIT_KINDS | {BY_DIGEST, BY_LIBRARY}
"""Parts of places that no body has: which model of several was taken."""
_HASH_DIGITS = 64
_HASH_HINT = (
    "A field is identified by the SHA-256 of its file. `sha256sum FILE` prints it, and POST /fields returns it."
)
_Model = TypeVar("_Model")


class _Fault(NamedTuple):
    kind: str
    place: tuple[str | int, ...]
    detail: str
    hint: str | None


def read_model(
    model: type[_Model],
    body: bytes,
    otherwise: str = "INVALID_REQUEST",
    most_values: int = MOST_VALUES,
    what: str = "The body",
) -> _Model:
    """The body, or a part of it that messages call ``what``, as ``model``, a pydantic model or dataclass, strictly.

    Raises Problem: MALFORMED_JSON, the faulty member's reason, or ``otherwise``.
    """
    text = json.dumps(parse_json(body, most_values, what))
    try:
        validated: _Model = _adapter(cast(Any, model)).validate_json(text, strict=True)
    except ValidationError as error:
        raise refusal(error, otherwise, model) from error
    return validated


@cache
def _adapter(model: Any) -> TypeAdapter[Any]:
    return TypeAdapter(model)


def refusal(error: ValidationError, otherwise: str, model: Any) -> Problem:
    """The problem for what a schema refused: the reason goes by the first faulty member, every fault is listed."""
    raw = error.errors(include_url=False)
    if any(fault["type"] == "json_invalid" for fault in raw):
        return Problem("MALFORMED_JSON", "A string has half of a surrogate pair.")
    faults = [_fault(entry, model) for entry in raw[:MAX_ERRORS]]
    deciding = next(filter(_reason, faults), None)
    reason = (deciding and _reason(deciding)) or otherwise
    detail = None
    if deciding is not None and deciding.kind == "missing":  # its reason speaks of one that is malformed
        detail = f"The member {json_pointer(deciding.place)} is missing."
    elif reason == "INVALID_DETECTION":
        detail = next((one.detail for one in faults if one.kind == DETECTION_FAULT), None)
    return Problem(
        reason,
        detail,
        errors=[{"pointer": json_pointer(one.place), "detail": one.detail} for one in faults],
        hint=next((one.hint for one in faults if one.hint), None),
    )


def _reason(fault: _Fault) -> str | None:
    """The reason of a fault: the one that its kind has, or the place."""
    if fault.kind == PRESET_FAULT or not fault.place:
        return "PRESET_UNSUITABLE" if fault.place else None
    within = next((_REASONS_WITHIN[str(part)] for part in fault.place[1:] if part in _REASONS_WITHIN), None)
    return within or _REASONS.get(str(fault.place[0]))


def _fault(entry: Any, model: Any) -> _Fault:
    kind = str(entry["type"])
    place = tuple(part for part in entry["loc"] if part not in _TAGS)
    detail = str(entry["msg"]).removeprefix("Value error, ")
    if kind == DETECTION_FAULT:
        context = entry["ctx"]
        return _Fault(kind, (*place, *context["place"]), str(context["message"]), context["hint"])
    if kind == UNKNOWN_OPTION and place[0] == "options" and len(place) > 1:
        meant = did_you_mean(place[1:])
        return _Fault(kind, place, "No such option" + meant, meant[2:3].upper() + meant[3:] or _meant(place, model))
    if kind in ("extra_forbidden", UNKNOWN_OPTION):
        return _Fault(kind, place, "This member is unknown.", _meant(place, model))
    if kind == "string_pattern_mismatch" and not _FIELDS.isdisjoint(place):
        return _Fault(kind, place, _hash_fault(str(entry["input"])), _HASH_HINT)
    return _Fault(kind, place, detail, None)


def _meant(place: Sequence[str | int], model: Any) -> str | None:
    known = members_at(model, place[:-1])
    listed = ", ".join(f"`{name}`" for name in sorted(known))
    return suggestion(str(place[-1]), known) or (f"Known here: {listed}." if known else None)


def _hash_fault(text: str) -> str:
    expected = f"expected {_HASH_DIGITS} lowercase hexadecimal digits"
    if len(text) == _HASH_DIGITS and text.lower() != text:
        return f"It has uppercase letters, {expected}."
    if len(text) != _HASH_DIGITS:
        return f"It has {len(text)} characters, {expected}."
    return f"It has other characters than digits and a to f, {expected}."


# Schemas that routes name in the contract by hand: naming one enters it into the contract.

REFERENCED: dict[str, type] = {}
"""Every model that was named, by its name in the contract."""


def reference(model: type) -> dict[str, Any]:
    """A reference to a model's schema; the contract lists the schema itself."""
    REFERENCED[model.__name__] = model
    return {"$ref": f"#/components/schemas/{model.__name__}"}
