"""YAML as a stream of events, turned into plain values by this module alone: no constructor of PyYAML's ever runs.

A tag (``!!python/object:...``) is kept as text. Aliases share one value, and count as often as they would be copied.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import yaml

from regnf_core.importing.settings.plain import (
    MAX_DEPTH,
    MAX_NODES,
    MAX_NUMBER_CHARACTERS,
    Tagged,
    decoded,
    malformed,
    too_large,
)

MAX_BYTES = 512 * 1024
_CORE = "tag:yaml.org,2002:"
_WORDS: dict[str, Any] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL"), None),
    **dict.fromkeys(("true", "True", "TRUE", "yes", "Yes", "YES", "on", "On", "ON"), True),
    **dict.fromkeys(("false", "False", "FALSE", "no", "No", "NO", "off", "Off", "OFF"), False),
    **dict.fromkeys((".inf", ".Inf", ".INF", "+.inf"), float("inf")),
    **dict.fromkeys(("-.inf", "-.Inf", "-.INF"), float("-inf")),
    **dict.fromkeys((".nan", ".NaN", ".NAN"), float("nan")),
}
_WHOLE = re.compile(r"[-+]?(0|[1-9][0-9_]*)")
_REAL = re.compile(r"[-+]?(([0-9][0-9_]*\.[0-9_]*|\.[0-9][0-9_]*)([eE][-+]?[0-9]+)?|[0-9]+[eE][-+]?[0-9]+)")
_MERGE = "<<"
_READABLE = frozenset({"str", "int", "float", "bool", "null", "map", "seq"})


def read_yaml(name: str, data: bytes | memoryview) -> Any:
    """The one document of the file ``name``. Raises FieldFormatError: SETTINGS_TOO_LARGE, SETTINGS_MALFORMED."""
    text = decoded(name, data, MAX_BYTES)
    try:
        return _Reader(name).document(yaml.parse(text, Loader=yaml.SafeLoader))
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark is not None else ""
        raise malformed(f"{name} is no sound YAML{where}") from error
    except (ValueError, RecursionError) as error:
        raise malformed(f"{name} is no sound YAML") from error


@dataclass
class _Open:
    """A mapping or sequence whose end has not come yet."""

    value: dict[Any, Any] | list[Any]
    tag: str | None
    anchor: str | None
    nodes_before: int
    key: Any = None
    has_key: bool = False
    merged: list[Any] = field(default_factory=list)


class _Reader:
    """Builds values from events, without recursion."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._nodes = 0
        self._anchors: dict[str, tuple[Any, int]] = {}
        """Of each finished anchor its value, and how many nodes it stands for."""

    def document(self, events: Iterator[yaml.Event]) -> Any:
        documents, result = 0, None
        stack: list[_Open] = []
        for event in events:
            if isinstance(event, yaml.DocumentStartEvent):
                documents += 1
                if documents > 1:
                    raise malformed(f"{self._name} holds several documents")
            elif isinstance(event, (yaml.MappingStartEvent, yaml.SequenceStartEvent)):
                self._count(1)
                if len(stack) >= MAX_DEPTH:
                    raise too_large(f"{self._name} is nested more than {MAX_DEPTH} deep")
                self._forget(event.anchor)
                value: Any = {} if isinstance(event, yaml.MappingStartEvent) else []
                stack.append(_Open(value, event.tag, event.anchor, self._nodes - 1))
            elif isinstance(event, (yaml.MappingEndEvent, yaml.SequenceEndEvent)):
                done = stack.pop()
                result = self._placed(stack, self._finished(done))
            elif isinstance(event, yaml.AliasEvent):
                result = self._placed(stack, self._alias(event.anchor))
            elif isinstance(event, yaml.ScalarEvent):
                self._count(1)
                value = _scalar(event)
                if event.anchor is not None:
                    self._anchors[event.anchor] = (value, 1)
                result = self._placed(stack, value, merge=event.value == _MERGE and event.implicit[0])
        return result

    def _count(self, nodes: int) -> None:
        self._nodes += nodes
        if self._nodes > MAX_NODES:
            raise too_large(f"{self._name} holds more than {MAX_NODES} values")

    def _forget(self, anchor: str | None) -> None:
        """An anchor means nothing until its value is finished: a value that holds itself is refused."""
        if anchor is not None:
            self._anchors.pop(anchor, None)

    def _alias(self, anchor: str | None) -> Any:
        if anchor is None or anchor not in self._anchors:
            raise malformed(f"{self._name} uses an anchor before its value is finished")
        value, nodes = self._anchors[anchor]
        self._count(nodes)
        return value

    def _finished(self, done: _Open) -> Any:
        if isinstance(done.value, dict):
            for merged in done.merged:
                self._merge(done.value, merged)
        value = _with_tag(done.value, done.tag)
        if done.anchor is not None:
            self._anchors[done.anchor] = (value, self._nodes - done.nodes_before)
        return value

    def _merge(self, into: dict[Any, Any], merged: Any) -> None:
        for part in merged if isinstance(merged, list) else [merged]:
            if not isinstance(part, dict):
                raise malformed(f"{self._name} merges something that is no mapping")
            for key, value in part.items():
                into.setdefault(key, value)

    def _placed(self, stack: list[_Open], value: Any, merge: bool = False) -> Any:
        """Put the finished value where it belongs; returns it."""
        if not stack:
            return value
        parent = stack[-1]
        if isinstance(parent.value, list):
            parent.value.append(value)
        elif not parent.has_key:
            parent.key, parent.has_key = _MERGE_KEY if merge else self._key(value), True
        else:
            self._enter(parent, value)
        return value

    def _key(self, value: Any) -> Any:
        if isinstance(value, (dict, list, Tagged)):
            return _NAMELESS
        return value

    def _enter(self, parent: _Open, value: Any) -> None:
        key, parent.has_key = parent.key, False
        if key is _NAMELESS or not isinstance(parent.value, dict):
            return
        if key is _MERGE_KEY:
            parent.merged.append(value)
            return
        if key in parent.value:
            raise malformed(f"{self._name} says {str(key)[:60]!r} twice")
        parent.value[key] = value


_NAMELESS, _MERGE_KEY = object(), object()
"""Keys that no setting has: a list, a mapping or an object; and the merge of YAML 1.1."""


def _with_tag(value: Any, tag: str | None) -> Any:
    if tag is None or tag == "!" or tag.removeprefix(_CORE) in _READABLE:
        return value
    return Tagged(tag, value)


def _scalar(event: yaml.ScalarEvent) -> Any:
    if event.tag is None:
        return _plain_scalar(event.value) if event.implicit[0] else event.value
    kind = event.tag.removeprefix(_CORE)
    if kind in ("int", "float", "bool", "null"):
        value = _plain_scalar(event.value)
        return float(value) if kind == "float" and isinstance(value, int) else value
    return _with_tag(event.value, event.tag)


def _plain_scalar(text: str) -> Any:
    if text in _WORDS:
        return _WORDS[text]
    if len(text) <= MAX_NUMBER_CHARACTERS:
        if _WHOLE.fullmatch(text):
            return int(text.replace("_", ""))
        if _REAL.fullmatch(text):
            return float(text.replace("_", ""))
    return text
