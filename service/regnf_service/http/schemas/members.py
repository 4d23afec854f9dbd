"""Which members a schema knows at a place, to name the one that was meant."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache
from typing import Any

from pydantic import TypeAdapter


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
