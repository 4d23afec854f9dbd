"""Settings files by name: each read by the reader of its format when a trainer's module asks for it."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

import yaml

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

# The part of HOCON that the .conf files of NeuS use: objects, lists, numbers, words, texts.
#
# What reaches out of the file (``include``, ``${...}``) is refused by its own reason. See decision 11.

MAX_HOCON_BYTES = 256 * 1024
_COMMENT = r"(?:#|//)[^\n]*"
_BLANKS = re.compile(rf"(?:[^\S\n]|\ufeff|{_COMMENT})*")
_LINES = re.compile(rf"(?:\s|\ufeff|{_COMMENT})*")
_BETWEEN = re.compile(rf"(?:[\s,]|\ufeff|{_COMMENT})*")
_QUOTED = re.compile(r'"((?:[^"\\\n]|\\["\\/bfnrt]|\\u[0-9a-fA-F]{4})*)"')
_TRIPLE = re.compile(r'"""(.*?)"""', re.DOTALL)
_KEY = re.compile(r"[A-Za-z0-9_\-]+(?:[ \t]*\.[ \t]*[A-Za-z0-9_\-]+)*")
_BARE = re.compile(r"(?:(?!//)[^\n,{}\[\]#\"$])+")
_INCLUDE = re.compile(r"include(?:[ \t]+\"|[ \t]+(?:required|file|url|classpath)[ \t]*\(|[ \t]*\()")
_NUMBER = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?")
_HOCON_WORDS: dict[str, Any] = {"true": True, "True": True, "false": False, "False": False, "null": None, "None": None}


def read_hocon(name: str, data: bytes | memoryview) -> dict[str, Any]:
    """The settings in the file ``name``. Raises FieldFormatError: SETTINGS_TOO_LARGE, SETTINGS_MALFORMED,
    SETTINGS_UNSAFE.
    """
    reader = _HoconReader(name, decoded(name, data, MAX_HOCON_BYTES))
    reader.match(_LINES)
    values: dict[str, Any] = {}
    reader.entries(values, 1, "}" if reader.take("{") else "")
    reader.match(_LINES)
    if reader.at != len(reader.text):
        raise reader.fault("there is data after the end of the settings")
    return values


class _HoconReader:
    """Reads from left to right; ``at`` is where it is."""

    def __init__(self, name: str, text: str) -> None:
        self.name, self.text, self.at, self.nodes = name, text, 0, 0

    def match(self, pattern: re.Pattern[str]) -> re.Match[str] | None:
        """What stands here, if it fits; then the reader stands behind it."""
        if (found := pattern.match(self.text, self.at)) is not None:
            self.at = found.end()
        return found

    def take(self, characters: str) -> bool:
        """Go over one of the characters, if it stands here."""
        found = self.at < len(self.text) and self.text[self.at] in characters
        self.at += found
        return found

    def entries(self, into: dict[str, Any], depth: int, end: str) -> None:
        """The entries of an object up to its closing brace, or to the end of the file."""
        while True:
            self.match(_BETWEEN)
            if self.take(end) or (not end and self.at == len(self.text)):
                return
            self._entry(into, depth)

    def _entry(self, into: dict[str, Any], depth: int) -> None:
        if _INCLUDE.match(self.text, self.at):
            raise unsafe(f"{self.name} includes another file; put the content of that file into this one")
        if (quoted := self.match(_QUOTED)) is not None:
            path = [_unescaped(quoted[1])]
        elif (found := self.match(_KEY)) is not None:
            path = [part.strip() for part in found[0].split(".")]
        else:
            raise self._unexpected("no key where one is expected")
        self._limit(len(path))
        self.match(_LINES)
        if self.take("=:"):
            self.match(_LINES)
        elif not self.text.startswith("{", self.at):
            raise self.fault("a key is followed by neither a value nor an object")
        for part in path[:-1]:
            if not isinstance(into.get(part), dict):
                into[part] = {}
            into = into[part]
        into[path[-1]] = self._value(depth + 1, into.get(path[-1]))
        self.match(_BLANKS)
        if self.at < len(self.text) and self.text[self.at] not in "\n,}":
            raise self.fault("a value of several parts")

    def _value(self, depth: int, before: Any = None) -> Any:
        """before: what the key had; two objects of one name are one."""
        self.nodes += 1
        self._limit(depth)
        if self.take("{"):
            values = before if isinstance(before, dict) else {}
            self.entries(values, depth, "}")
            return values
        if self.take("["):
            return self._list(depth)
        if (triple := self.match(_TRIPLE)) is not None:
            return triple[1]
        if (quoted := self.match(_QUOTED)) is not None:
            return _unescaped(quoted[1])
        if (found := self.match(_BARE)) is None or self.text.startswith("$", self.at):
            raise self._unexpected("no value where one is expected")
        return _word(found[0].strip())

    def _list(self, depth: int) -> list[Any]:
        values: list[Any] = []
        while True:
            self.match(_BETWEEN)
            if self.take("]"):
                return values
            values.append(self._value(depth + 1))
            self.match(_BLANKS)
            if self.at >= len(self.text) or self.text[self.at] not in "\n,]":
                raise self.fault("a list's value of several parts, or a list without an end")

    def _limit(self, depth: int) -> None:
        if self.nodes > MAX_NODES:
            raise too_large(f"{self.name} holds more than {MAX_NODES} values")
        if depth > MAX_DEPTH:
            raise too_large(f"{self.name} is nested more than {MAX_DEPTH} deep")

    def _unexpected(self, what: str) -> Exception:
        if self.text.startswith("${", self.at):
            return unsafe(f"{self.name} refers to a value elsewhere (${{...}}); write the value itself")
        return self.fault(what)

    def fault(self, what: str) -> Exception:
        """The error for what stands here."""
        line = self.text.count("\n", 0, self.at) + 1
        return malformed(f"{self.name}, line {line}: {what}")


def _word(text: str) -> Any:
    if text in _HOCON_WORDS:
        return _HOCON_WORDS[text]
    if len(text) <= MAX_NUMBER_CHARACTERS and _NUMBER.fullmatch(text):
        return float(text) if any(c in text for c in ".eE") else int(text)
    return text


def _unescaped(text: str) -> str:
    """A quoted text has JSON's escapes, and may hold tabs."""
    return str(json.loads(f'"{text}"', strict=False))


# YAML as PyYAML's nodes, turned into plain values by this module alone: no constructor of PyYAML's ever runs.
#
# A tag (``!!python/object:...``) is kept as text. What an alias stands for counts as often as it would be copied.

MAX_BYTES = 512 * 1024
_CORE, _UNTAGGED = "tag:yaml.org,2002:", "?"
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
_READABLE = frozenset({"", "str", "map", "seq"})


def read_yaml(name: str, data: bytes | memoryview) -> Any:
    """The one document of the file ``name``. Raises FieldFormatError: SETTINGS_TOO_LARGE, SETTINGS_MALFORMED."""
    text = decoded(name, data, MAX_BYTES)
    try:
        reader = _YamlReader(name, text)
        root = reader.get_single_node()
        return None if root is None else reader.value(root)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark is not None else ""
        raise malformed(f"{name} is not valid YAML{where}") from error
    except (ValueError, RecursionError) as error:
        raise malformed(f"{name} is not valid YAML") from error


class _YamlReader(yaml.SafeLoader):
    """PyYAML's nodes, limited in number and depth, and their values."""

    def __init__(self, name: str, text: str) -> None:
        super().__init__(text)
        self._file, self._composed, self._nodes, self._depth = name, 0, 0, 0
        self._open: set[yaml.Node] = set()

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        self._composed += 1
        self._limit(self._composed, self._depth)
        self._depth += 1
        node: yaml.Node | None = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def resolve(self, kind: Any, value: Any, implicit: Any) -> str:  # noqa: ARG002 (PyYAML's)
        """The tag of a node without one: only words without quotes may be numbers, true, false or null."""
        return _UNTAGGED if kind is yaml.ScalarNode and implicit[0] else ""

    def value(self, node: yaml.Node, depth: int = 0) -> Any:
        """What the node says, as plain values and :class:`Tagged`."""
        self._nodes += 1
        self._limit(self._nodes, depth)
        if isinstance(node, yaml.ScalarNode):
            return _scalar(node)
        if node in self._open:
            raise malformed(f"{self._file} uses an anchor before its value is finished")
        self._open.add(node)
        mapping = isinstance(node, yaml.MappingNode)
        value = self._mapping(node, depth + 1) if mapping else [self.value(part, depth + 1) for part in node.value]
        self._open.remove(node)
        return _with_tag(value, node.tag)

    def _mapping(self, node: yaml.Node, depth: int) -> dict[Any, Any]:
        values: dict[Any, Any] = {}
        merged: list[Any] = []
        for key_node, value_node in node.value:
            key, value = self.value(key_node, depth), self.value(value_node, depth)
            if (key_node.tag, key_node.value) == (_UNTAGGED, "<<"):
                merged.extend(value if isinstance(value, list) else [value])
            elif isinstance(key, (dict, list, Tagged)):
                continue  # no setting has such a key
            elif key in values:
                raise malformed(f"{self._file} says {str(key)[:60]!r} twice")
            else:
                values[key] = value
        for part in merged:
            if not isinstance(part, dict):
                raise malformed(f"{self._file} merges something that is not a mapping")
            values = {**part, **values}
        return values

    def _limit(self, nodes: int, depth: int) -> None:
        if nodes > MAX_NODES:
            raise too_large(f"{self._file} holds more than {MAX_NODES} values")
        if depth > MAX_DEPTH:
            raise too_large(f"{self._file} is nested more than {MAX_DEPTH} deep")


def _with_tag(value: Any, tag: str) -> Any:
    return value if tag.removeprefix(_CORE) in _READABLE else Tagged(tag, value)


def _scalar(node: yaml.ScalarNode) -> Any:
    kind = node.tag.removeprefix(_CORE)
    if kind not in (_UNTAGGED, "int", "float", "bool", "null"):
        return _with_tag(node.value, node.tag)
    value = _plain_scalar(node.value)
    return float(value) if kind == "float" and isinstance(value, int) else value


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
        return next((keys for keys in self.keys if keys.file == name), None)

    def mappings(self) -> Iterator[Keys]:
        """The texts that hold keys at all."""
        return (keys for keys in self.keys if isinstance(keys.find(""), dict))


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
