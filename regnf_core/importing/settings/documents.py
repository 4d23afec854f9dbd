"""Settings files by name: each read by the reader of its format when a trainer's module asks for it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import Any

import yaml

from regnf_core.errors import FieldFormatError
from regnf_core.importing.containers.npz import ArraySource
from regnf_core.importing.run.opened import SettingsFile
from regnf_core.importing.settings.keys import (
    MAX_DEPTH,
    MAX_NODES,
    MAX_NUMBER_CHARACTERS,
    Keys,
    Tagged,
    decoded,
    looks_like_json,
    malformed,
    read_json,
    too_large,
    unsafe,
)

# The part of HOCON that the .conf files of NeuS, IDR, VolSDF and MonoSDF use: objects, lists, numbers, words, texts.
#
# What reaches out of the file (``include``, ``${...}``) is refused by its own reason. See decision 11.

MAX_HOCON_BYTES = 256 * 1024
_SPACE = re.compile(r"[ \t\r\f\v\u00a0\ufeff]+")
_COMMENT = re.compile(r"(#|//)[^\n]*")
_QUOTED = re.compile(r'"((?:[^"\\\n]|\\["\\/bfnrt]|\\u[0-9a-fA-F]{4})*)"')
_TRIPLE = re.compile(r'"""(.*?)"""', re.DOTALL)
_KEY = re.compile(r"[A-Za-z0-9_\-]+(?:[ \t]*\.[ \t]*[A-Za-z0-9_\-]+)*")
_BARE = re.compile(r"(?:(?!//)[^\n,{}\[\]#\"$])+")
_INCLUDE = re.compile(r"include(?:[ \t]+\"|[ \t]+(?:required|file|url|classpath)[ \t]*\(|[ \t]*\()")
_NUMBER = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?")
_ESCAPES = {"b": "\b", "f": "\f", "n": "\n", "r": "\r", "t": "\t"}
_ESCAPE = re.compile(r"\\(u[0-9a-fA-F]{4}|.)")
_HOCON_WORDS: dict[str, Any] = {"true": True, "True": True, "false": False, "False": False, "null": None, "None": None}


def read_hocon(name: str, data: bytes | memoryview) -> dict[str, Any]:
    """The settings in the file ``name``. Raises FieldFormatError: SETTINGS_TOO_LARGE, SETTINGS_MALFORMED,
    SETTINGS_UNSAFE.
    """
    return _HoconReader(name, decoded(name, data, MAX_HOCON_BYTES)).whole()


class _HoconReader:
    """Reads from left to right; ``_at`` is where it is."""

    def __init__(self, name: str, text: str) -> None:
        self._name, self._text, self._at, self._nodes = name, text, 0, 0

    def whole(self) -> dict[str, Any]:
        self._skip(lines=True)
        braces = self._take("{")
        values: dict[str, Any] = {}
        self._entries(values, 1, "}" if braces else "")
        self._skip(lines=True)
        if self._at != len(self._text):
            raise self._fault("something lies behind the settings' end")
        return values

    def _entries(self, into: dict[str, Any], depth: int, end: str) -> None:
        """The entries of an object up to its closing brace, or to the end of the file."""
        self._descend(depth)
        while True:
            self._skip(lines=True)
            while self._take(","):
                self._skip(lines=True)
            if self._at == len(self._text) and not end:
                return
            if end and self._take(end):
                return
            self._entry(into, depth)

    def _entry(self, into: dict[str, Any], depth: int) -> None:
        if _INCLUDE.match(self._text, self._at):
            raise unsafe(f"{self._name} includes another file; put its settings into this one")
        path = self._path()
        self._skip(lines=True)
        if self._text.startswith("{", self._at):
            value = self._value(depth + 1, self._object_at(into, path))
        elif self._take("=") or self._take(":"):
            self._skip(lines=True)
            before = self._object_at(into, path) if self._text.startswith("{", self._at) else None
            value = self._value(depth + 1, before)
        else:
            raise self._fault("a key is followed by neither a value nor an object")
        self._enter(into, path, value)
        self._skip()
        if self._at < len(self._text) and self._text[self._at] not in "\n,}":
            raise self._fault("a value of several parts")

    def _path(self) -> list[str]:
        if (quoted := _QUOTED.match(self._text, self._at)) is not None:
            self._at = quoted.end()
            return [_unescaped(quoted[1])]
        if (found := _KEY.match(self._text, self._at)) is None:
            raise self._reaches_out() or self._fault("no key where one is expected")
        self._at = found.end()
        return [part.strip() for part in found[0].split(".")]

    def _object_at(self, into: dict[str, Any], path: list[str]) -> dict[str, Any] | None:
        """The object that is there already: two of one name are one."""
        here: Any = into
        for part in path:
            here = here.get(part) if isinstance(here, dict) else None
        return here if isinstance(here, dict) else None

    def _enter(self, into: dict[str, Any], path: list[str], value: Any) -> None:
        self._descend(len(path))
        for part in path[:-1]:
            below = into.get(part)
            if not isinstance(below, dict):
                below = into[part] = {}
            into = below
        into[path[-1]] = value

    def _value(self, depth: int, before: dict[str, Any] | None = None) -> Any:
        self._count()
        if self._take("{"):
            values = {} if before is None else before
            self._entries(values, depth, "}")
            return values
        if self._take("["):
            return self._list(depth)
        for pattern in (_TRIPLE, _QUOTED):
            if (found := pattern.match(self._text, self._at)) is not None:
                self._at = found.end()
                return found[1] if pattern is _TRIPLE else _unescaped(found[1])
        if (found := _BARE.match(self._text, self._at)) is None:
            raise self._reaches_out() or self._fault("no value where one is expected")
        self._at = found.end()
        if self._text.startswith("$", self._at):
            raise self._reaches_out() or self._fault("a lone $")
        return _word(found[0].strip())

    def _list(self, depth: int) -> list[Any]:
        self._descend(depth)
        values: list[Any] = []
        while True:
            self._skip(lines=True)
            while self._take(","):
                self._skip(lines=True)
            if self._take("]"):
                return values
            values.append(self._value(depth + 1))
            self._skip()
            if self._at >= len(self._text) or self._text[self._at] not in "\n,]":
                raise self._fault("a list's value of several parts, or a list without an end")

    def _skip(self, lines: bool = False) -> None:
        """Go over blanks and comments; over the ends of lines too where asked for."""
        while True:
            found = _SPACE.match(self._text, self._at) or _COMMENT.match(self._text, self._at)
            if found is not None:
                self._at = found.end()
            elif not (lines and self._take("\n")):
                return

    def _take(self, character: str) -> bool:
        if not character or not self._text.startswith(character, self._at):
            return False
        self._at += 1
        return True

    def _count(self) -> None:
        self._nodes += 1
        if self._nodes > MAX_NODES:
            raise too_large(f"{self._name} holds more than {MAX_NODES} values")

    def _descend(self, depth: int) -> None:
        if depth > MAX_DEPTH:
            raise too_large(f"{self._name} is nested more than {MAX_DEPTH} deep")

    def _reaches_out(self) -> Exception | None:
        if self._text.startswith("${", self._at):
            return unsafe(f"{self._name} substitutes a value from elsewhere (${{...}}); write the value itself")
        return None

    def _fault(self, what: str) -> Exception:
        line = self._text.count("\n", 0, self._at) + 1
        return malformed(f"{self._name}, line {line}: {what}")


def _word(text: str) -> Any:
    if text in _HOCON_WORDS:
        return _HOCON_WORDS[text]
    if len(text) <= MAX_NUMBER_CHARACTERS and _NUMBER.fullmatch(text):
        return float(text) if any(c in text for c in ".eE") else int(text)
    return text


def _unescaped(text: str) -> str:
    return _ESCAPE.sub(lambda found: _character(found[1]), text)


def _character(escape: str) -> str:
    return chr(int(escape[1:], 16)) if len(escape) == 5 else _ESCAPES.get(escape, escape)


# YAML as a stream of events, turned into plain values by this module alone: no constructor of PyYAML's ever runs.
#
# A tag (``!!python/object:...``) is kept as text. Aliases share one value, and count as often as they would be
# copied.

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


_YAML, _HOCON, _JSON, _ARRAYS, _TENSORS = (".yml", ".yaml"), (".conf", ".hocon"), (".json",), (".npz",), (".pth", ".pt")
_ARRAY_BYTES = 1 << 20


@dataclass(frozen=True)
class Documents:
    """All settings files of one run."""

    keys: tuple[Keys, ...]
    """The texts, parsed, in the order in which they were found."""
    arrays: tuple[tuple[str, ArraySource], ...]
    tensors: tuple[SettingsFile, ...]
    """Files of torch.save beside the settings: latent codes."""

    def named(self, name: str) -> Keys | None:
        """The text of this name, if it is there."""
        return next((keys for keys in self.keys if keys.file == name), None)


def read_documents(files: tuple[SettingsFile, ...]) -> Documents:
    """Raises FieldFormatError: the SETTINGS_* reasons, and those of a malformed .npz file."""
    keys, arrays, tensors = [], [], []
    for file in files:
        name = PurePosixPath(file.name).name
        end = PurePosixPath(name).suffix.lower()
        if end in _ARRAYS:
            arrays.append((name, ArraySource(file.data, _ARRAY_BYTES)))
        elif end in _TENSORS:
            tensors.append(file)
        else:
            keys.append(Keys(name, _tree(name, end, file.data)))
    return Documents(tuple(keys), tuple(arrays), tuple(tensors))


def _tree(name: str, end: str, data: memoryview) -> Any:
    """By the name's end; of a name without a known one, by the first bytes."""
    if end in _HOCON:
        return read_hocon(name, data)
    if end in _JSON or (end not in _YAML and looks_like_json(data)):
        return read_json(name, data)
    return read_yaml(name, data)


def mappings(documents: Documents) -> Iterator[Keys]:
    """The texts that hold keys at all."""
    for keys in documents.keys:
        if isinstance(keys.find(""), dict):
            yield keys


def optional_arrays(documents: Documents, array: str) -> tuple[str, list[list[float]]] | None:
    """The small matrix ``array`` of the first .npz file that has it, and that file's name."""
    for name, source in documents.arrays:
        if array in source:
            values = source.numbers(array)
            if values.ndim != 2:
                raise FieldFormatError(f"{name}: {array} is no matrix", reason="SETTINGS_MALFORMED")
            return name, values.tolist()
    return None
