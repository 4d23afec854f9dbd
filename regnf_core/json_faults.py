"""Why a text is no JSON, and what to change: for files at the command line and bodies of the HTTP interface alike."""

from __future__ import annotations

import json
import re

_LITERALS = {"None": "null", "True": "true", "False": "false"}
_TRAILING_COMMA = re.compile(r",\s*[}\]]")


def json_fault(error: json.JSONDecodeError) -> tuple[str, str]:
    """The message, with line and column, and the hint. Nothing of the text is repeated."""
    where = f"not JSON from line {error.lineno}, column {error.colno} on"
    return where, _hint(error)


def _hint(error: json.JSONDecodeError) -> str:
    text, at = error.doc, error.pos
    if not text.strip():
        return "It is empty. A JSON value is expected."
    if _TRAILING_COMMA.match(text, _last_comma(text, at)):
        return "Remove the comma before the closing bracket."
    if text[at : at + 1] == "'":
        return 'JSON takes double quotes: "center", with no single ones.'
    for word, meant in _LITERALS.items():
        if text.startswith(word, at):
            return f"Write {meant}: JSON has no {word}."
    if text[at : at + 1] in ("#", "/"):
        return "JSON has no comments. Remove them."
    if text.lstrip()[:1] == "<":
        return "It begins like HTML or XML: a download of a web page instead of the file?"
    if re.match(r"\s*[A-Za-z_]\w*\s*:", text):
        return 'It looks like YAML. Write it as JSON: {"center": [x, y, z], ...}.'
    if at >= len(text.rstrip()):
        return "It ends too early: a closing bracket or quotation mark is missing."
    return "Check the brackets, commas and quotation marks there."


def _last_comma(text: str, at: int) -> int:
    """Where the last comma before ``at`` is, if only white space lies between; else ``at``."""
    before = text[: at + 1].rstrip()
    if before and before[-1] in "}]":
        before = before[:-1].rstrip()
    return len(before) - 1 if before.endswith(",") else at
