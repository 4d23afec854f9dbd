"""The part of HOCON that the .conf files of NeuS, IDR, VolSDF and MonoSDF use: objects, lists, numbers, words, texts.

What reaches out of the file (``include``, ``${...}``) is refused by its own reason. See decision 11.
"""

from __future__ import annotations

import re
from typing import Any

from regnf_core.importing.settings.plain import (
    MAX_DEPTH,
    MAX_NODES,
    MAX_NUMBER_CHARACTERS,
    decoded,
    malformed,
    too_large,
    unsafe,
)

MAX_BYTES = 256 * 1024
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
_WORDS: dict[str, Any] = {"true": True, "True": True, "false": False, "False": False, "null": None, "None": None}


def read_hocon(name: str, data: bytes | memoryview) -> dict[str, Any]:
    """The settings in the file ``name``. Raises FieldFormatError: SETTINGS_TOO_LARGE, SETTINGS_MALFORMED,
    SETTINGS_UNSAFE.
    """
    return _Reader(name, decoded(name, data, MAX_BYTES)).whole()


class _Reader:
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
    if text in _WORDS:
        return _WORDS[text]
    if len(text) <= MAX_NUMBER_CHARACTERS and _NUMBER.fullmatch(text):
        return float(text) if any(c in text for c in ".eE") else int(text)
    return text


def _unescaped(text: str) -> str:
    return _ESCAPE.sub(lambda found: _character(found[1]), text)


def _character(escape: str) -> str:
    return chr(int(escape[1:], 16)) if len(escape) == 5 else _ESCAPES.get(escape, escape)
