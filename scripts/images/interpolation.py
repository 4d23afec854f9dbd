"""Variables in a compose file, replaced as the Compose Specification says: `$NAME`, `${NAME}`, defaults and conditions.

    ${NAME:-text}  ${NAME-text}   text where NAME is unset or empty; only where it is unset
    ${NAME:?text}  ${NAME?text}   an error with that text in the same cases
    ${NAME:+text}  ${NAME+text}   text where NAME is set and not empty; wherever it is set
    $$                            a dollar sign

Texts may hold variables themselves. A variable that is unset becomes nothing.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_OPERATOR = re.compile(r":?[-?+]")


class ComposeError(ValueError):
    """What compose refuses to render."""


def interpolated(document: Any, variables: Mapping[str, str]) -> Any:
    """The document with every text in it interpolated. Keys are left as they are, as in compose."""
    if isinstance(document, str):
        return interpolate(document, variables)
    if isinstance(document, dict):
        return {key: interpolated(value, variables) for key, value in document.items()}
    if isinstance(document, list):
        return [interpolated(value, variables) for value in document]
    return document


def interpolate(text: str, variables: Mapping[str, str]) -> str:
    """The text with its variables replaced. Raises ComposeError."""
    parts = []
    position = 0
    while (dollar := text.find("$", position)) >= 0:
        parts.append(text[position:dollar])
        value, position = _expression(text, dollar + 1, variables)
        parts.append(value)
    return "".join([*parts, text[position:]])


def _expression(text: str, start: int, variables: Mapping[str, str]) -> tuple[str, int]:
    """The value of the expression after a dollar sign, and where the text goes on."""
    if text.startswith("$", start):
        return "$", start + 1
    if text.startswith("{", start):
        end = _closing_brace(text, start + 1)
        return _braced(text[start + 1 : end], variables), end + 1
    name = _NAME.match(text, start)
    if name is None:
        raise ComposeError(f"invalid interpolation format: {text!r}; a dollar sign is written $$")
    return variables.get(name[0], ""), name.end()


def _closing_brace(text: str, start: int) -> int:
    depth = 1
    for position in range(start, len(text)):
        if text[position] == "{" and text[position - 1] == "$":
            depth += 1
        elif text[position] == "}":
            depth -= 1
        if depth == 0:
            return position
    raise ComposeError(f"invalid interpolation format: {text!r}; a brace is not closed")


def _braced(inside: str, variables: Mapping[str, str]) -> str:
    name = _NAME.match(inside)
    operator = _OPERATOR.match(inside, name.end()) if name else None
    if name is None or (operator is None and name.end() < len(inside)):
        raise ComposeError(f"invalid interpolation format: ${{{inside}}}")
    value = variables.get(name[0])
    if operator is None:
        return value or ""
    text = inside[operator.end() :]
    present = bool(value) if operator[0].startswith(":") else value is not None
    match operator[0][-1]:
        case "-":
            return value or "" if present else interpolate(text, variables)
        case "+":
            return interpolate(text, variables) if present else ""
        case _:
            if present:
                return value or ""
            raise ComposeError(f"required variable {name[0]} is missing a value: {interpolate(text, variables)}")
