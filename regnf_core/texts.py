"""Texts that people wrote, as their programs save them: from bytes to text, and from text to the values of JSON.

Files at the command line, settings beside a checkpoint, files of tokens and bodies of the HTTP interface all come
through here.
"""

from __future__ import annotations

import codecs
import io
import json
import re
from typing import Any

from regnf_core.errors import InvalidInputError

_TELLING_BYTES = 4
"""Of a text's beginning: they tell its encoding."""
_MARK = "\N{ZERO WIDTH NO-BREAK SPACE}"
_LINE_ENDS = re.compile(r"\r\n?")
_MARKS = re.compile(f"^{_MARK}+", re.MULTILINE)
_BINARY = re.compile(r"[\x00-\x08\x0e-\x1f]")
_LITERALS = {"None": "null", "True": "true", "False": "false"}
_TRAILING_COMMA = re.compile(r",\s*[}\]]")
_CURLED = "\N{LEFT DOUBLE QUOTATION MARK}\N{RIGHT DOUBLE QUOTATION MARK}\N{DOUBLE LOW-9 QUOTATION MARK}"

for _name in ("cp1252", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32", "utf-32-le", "utf-32-be"):
    codecs.lookup(_name)  # now: the import's process may load no module once it is confined


class TextError(ValueError):
    """Bytes that are no text in any encoding that is tried. The message goes on from "FILE is "; it repeats nothing."""


def decode_text(data: bytes | bytearray | memoryview) -> str:
    """The text in ``data``, its lines ended by a line feed and without byte order marks.

    The mark says which of UTF-8, UTF-16 and UTF-32 it is; without one, zeros between the first characters do. What is
    not UTF-8 then is taken as Windows-1252, unless it begins as UTF-8: then it is damaged. Raises TextError.
    """
    raw = bytes(data)
    encoding = json.detect_encoding(raw)
    try:
        text = codecs.decode(raw, encoding)
    except UnicodeDecodeError as error:
        text = _windows(raw, error)
    # without a mark, zeros have told the encoding: files of numbers have some, too
    if encoding.endswith(("-le", "-be")) and (odd := _BINARY.search(text)):
        raise TextError(f"not a text in UTF-8 or {encoding.upper()}: it has the control character {ord(odd[0]):#04x}")
    # files that were joined by `cat` or `type` have a mark in the middle, at the start of a line
    return _MARKS.sub("", _LINE_ENDS.sub("\n", text))


def _windows(raw: bytes, error: UnicodeDecodeError) -> str:
    """The text in Windows-1252, which nearly all bytes are: those of other files are told by control characters."""
    name, start = error.encoding.upper(), error.start
    place = f"byte {start + len(raw) - len(error.object) + 1} ({error.object[start]:#04x})"
    if name != "UTF-8" or not raw[:start].isascii() or raw.startswith(codecs.BOM_UTF8):
        raise TextError(f"not a text in {name}, from {place} on") from error
    if _BINARY.search(raw.decode("latin-1")):
        raise TextError(f"not a text in UTF-8 from {place} on, and it has control characters") from error
    try:
        return raw.decode("cp1252")
    except UnicodeDecodeError as other:
        worse = f"byte {other.start + 1} ({raw[other.start]:#04x})"
        raise TextError(f"not a text in UTF-8 from {place} on, and not in Windows-1252, which lacks {worse}") from error


def is_binary(text: str) -> bool:
    """Whether a text has control characters that no text has."""
    return _BINARY.search(text) is not None


class TextStream:
    """A text that arrives in pieces of any size, as lines that ``decode_text`` reads one by one.

    Line ends become line feeds. UTF-16 and UTF-32, which have bytes like them within characters, become UTF-8.
    """

    def __init__(self) -> None:
        self._head = b""
        self._source = self._target = ""
        self._decoder: io.IncrementalNewlineDecoder | None = None

    def feed(self, data: bytes, *, final: bool = False) -> bytes:
        """What ``data`` adds. ``final``: nothing comes after it. Raises TextError."""
        if self._decoder is None:
            self._head += data
            if len(self._head) < _TELLING_BYTES and not final:
                return b""
            data, told = self._head, json.detect_encoding(self._head)
            # any byte is a character of Latin-1: the lines stay as they are
            wide = told.startswith(("utf-16", "utf-32"))
            self._source, self._target = (told, "utf-8") if wide else ("latin-1", "latin-1")
            self._decoder = io.IncrementalNewlineDecoder(codecs.getincrementaldecoder(self._source)(), translate=True)
        try:
            return self._decoder.decode(data, final).encode(self._target)
        except UnicodeError as error:
            raise TextError(f"not a text in {self._source.upper()}") from error


def json_value(data: bytes | str, what: str = "", **how: Any) -> Any:
    """The value of a JSON text; ``what`` begins the message, ``how`` goes on to json.loads.

    Raises InvalidInputError (MALFORMED_JSON), which repeats nothing of the text.
    """
    try:
        return json.loads(data.lstrip(_MARK) if isinstance(data, str) else decode_text(data), **how)
    except json.JSONDecodeError as error:
        message, hint = f"not JSON from line {error.lineno}, column {error.colno} on", _hint(error)
    except TextError as error:
        message, hint = str(error), "Is it a field or a picture? JSON is expected here, saved as UTF-8."
    except RecursionError:
        message, hint = "too deeply nested lists", "A box has at most two levels of lists."
    except ValueError:
        message, hint = "a number of too many digits", "Write fewer digits."
    raise InvalidInputError(f"{what}{message}", reason="MALFORMED_JSON", hint=hint)


def _hint(error: json.JSONDecodeError) -> str:
    text, at = error.doc, error.pos
    if not text.strip():
        return "It is empty. A JSON value is expected."
    before = text[: at + 1].rstrip().rstrip("}]").rstrip()
    if before.endswith(",") and _TRAILING_COMMA.match(text, len(before) - 1):
        return "Remove the comma before the closing bracket."
    if text[at : at + 1] == "'":
        return 'JSON needs double quotes: "center". Replace the single quotes.'
    if text[at : at + 1] and text[at] in _CURLED:
        return 'JSON needs straight quotes: "center". A word processor has replaced them.'
    for word, meant in _LITERALS.items():
        if text.startswith(word, at):
            return f"Write {meant}: JSON has no {word}."
    if text[at : at + 1] in ("#", "/"):
        return "JSON has no comments. Remove them."
    if text.lstrip()[:1] == "<":
        return "It begins like HTML or XML. Check whether a web page was downloaded instead of the file."
    if re.match(r"\s*[A-Za-z_]\w*\s*:", text):
        return 'It looks like YAML. Write it as JSON: {"center": [x, y, z], ...}.'
    if at >= len(text.rstrip()):
        return "It ends too early: a closing bracket or quotation mark is missing."
    if not text[at].isascii():
        return f"The character there is U+{ord(text[at]):04X}, which JSON allows only within texts. Replace it."
    return "Check the brackets, commas and quotation marks there."
