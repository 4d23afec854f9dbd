"""The files of `regnf batch`: pairs to be registered, and the results so far."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from regnf_cli.options import as_transform, is_json
from regnf_core.detections.images import plain_values, read_detection
from regnf_core.errors import InvalidInputError, RegnfError, suggestion
from regnf_core.options import RegistrationOptions
from regnf_core.texts import TextError, decode_text, is_binary, json_value
from regnf_core.version import ENGINE_REVISION

MEMBERS = ("key", "scene", "object", "candidates", "detection", "detection_index", "options", "seed")
_MORE = ("initial_transform", "ground_truth", "pictures")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_KNOWN = frozenset((*MEMBERS, *_MORE))
_HINT = 'Write {"scene": FILE, "object": FILE, "detection": BOX or FILE} on each line.'
_HEADER_HINT = "Write the column names in the first line: scene,object,detection and any of " + ", ".join(MEMBERS) + "."
_LINE_BEGINS = b'{"id": "'
"""How every line of results begins: what is otherwise is another file of the user's."""
_JSON_LINES = frozenset({".jsonl", ".ndjson", ".json"})
_DELIMITERS = ",;\t|"
_SEPARATOR_TOLD = re.compile(r"\"?sep=([,;\t|])\"?", re.IGNORECASE)
_INVISIBLE = " \t\u00a0\u200b\u200c\u200d\u2060\ufeff"
_WHOLE = re.compile(r"(\d{1,10})(?:[.,]0*)?")
"""Also as a spreadsheet writes the whole numbers of a column that has empty cells."""
_TRUTH = {"true": True, "wahr": True, "false": False, "falsch": False}
"""As spreadsheets write them, a German one too."""


@dataclass(frozen=True)
class FilePair:
    """One pair of the file, with absolute paths. error: why it is none; then the rest says nothing.

    request: members of POST /register but the fields, with the box and the options as values · id: of what is asked.
    """

    line: int
    id: str
    key: str | None = None
    scene: str = ""
    objects: tuple[str, ...] = ()
    is_search: bool = False
    request: Mapping[str, Any] | None = None
    error: RegnfError | None = None


def _wrong(message: str, hint: str = _HINT) -> InvalidInputError:
    return InvalidInputError(message, reason="INVALID_REQUEST", hint=hint)


def read_pairs(path: Path) -> Iterator[FilePair]:
    """The pairs of a JSON Lines file, or of a CSV file with the members' names in its first line.

    Raises InvalidInputError (TEXT_UNREADABLE, INVALID_REQUEST) for a file of which no line can be read.
    """
    data = path.read_bytes()
    try:
        text = decode_text(data).rstrip("\0\x1a")
        if is_binary(text):
            raise TextError("not a text: it has control characters")
    except TextError as error:
        hint = "Save a spreadsheet as CSV." if data.startswith((b"PK", b"\xd0\xcf")) else "Save it as UTF-8."
        raise InvalidInputError(f"{path} is {error}", reason="TEXT_UNREADABLE", hint=hint) from error
    is_table = not (is_json(text) or path.suffix.lower() in _JSON_LINES)
    for number, given in _csv_lines(path, text) if is_table else _json_lines(path, text):
        yield _pair(path.resolve().parent, number, given)


def _csv_lines(path: Path, text: str) -> Iterator[tuple[int, Any]]:
    """Each row with its line's number. Rows and columns that are wholly empty are passed over."""
    head, _, rest = text.partition("\n")
    told = _SEPARATOR_TOLD.fullmatch(head.strip())  # Excel's own first line
    delimiter = told[1] if told else _delimiter(head)
    rows = csv.reader(io.StringIO(rest if told else text), delimiter=delimiter, skipinitialspace=True, strict=True)
    skipped = 1 if told else 0
    try:
        names = [name.strip(_INVISIBLE) for name in next((row for row in rows if any(row)), [])]
        while names and not names[-1]:
            names.pop()
        _check_header(path, names, rows.line_num + skipped)
        for row in rows:
            if any(cell.strip() for cell in row):
                yield rows.line_num + skipped, _row(names, row)
    except csv.Error as error:
        raise _wrong(f"{path}, line {rows.line_num + skipped}: not a table: {error}", _HEADER_HINT) from error


def _row(names: list[str], row: list[str]) -> dict[str, Any] | RegnfError:
    """The members that a row says, or why it is none."""
    cells = [cell.strip() for cell in row]
    if any(cells[len(names) :]):
        message = f"the row has {len(cells)} cells, the header {len(names)}"
        return _wrong(message, "Put a cell that contains the separator into double quotes.")
    try:
        return {name: _cell(name, cell) for name, cell in zip(names, cells, strict=False) if cell}
    except InvalidInputError as error:
        return error


def _delimiter(head: str) -> str:
    """The one that makes most known names of the header."""

    def known(delimiter: str) -> int:
        names = next(csv.reader([head], delimiter=delimiter, skipinitialspace=True), [])
        return len({name.strip(_INVISIBLE) for name in names} & _KNOWN)

    return max(_DELIMITERS, key=known)


def _check_header(path: Path, names: list[str], line: int) -> None:
    """Raises InvalidInputError (INVALID_REQUEST), once for all rows."""
    try:
        _check_names(names)
        if len(set(names)) < len(names):
            raise _wrong("a column name occurs twice", _HEADER_HINT)
    except InvalidInputError as error:
        hint = error.hint if error.hint and error.hint != _HINT else _HEADER_HINT
        raise InvalidInputError(f"{path}, line {line}, the header: {error}", reason=error.reason, hint=hint) from error


def _cell(name: str, text: str) -> Any:
    """The value that a cell stands for: a number, a truth value or JSON where the member is one."""
    if name in ("seed", "detection_index") and (number := _WHOLE.fullmatch(text)):
        return int(number[1])
    if name == "pictures":
        return _TRUTH.get(text.lower(), text)
    if name in ("candidates", "initial_transform", "ground_truth") and is_json(text):
        return json_value(text, f"{name}: ")
    return text


def _json_lines(path: Path, text: str) -> Iterator[tuple[int, Any]]:
    if text.lstrip()[:1] == "[" or text.lstrip().split("\n", 1)[0].strip() == "{":
        raise _wrong(f"{path}: a single JSON value, expected a JSON object on each line")
    for number, line in enumerate(text.split("\n"), 1):
        if line.strip():
            try:
                yield number, json_value(line, "the line is ")
            except InvalidInputError as error:
                yield number, error


def _pair(folder: Path, line: int, given: Any) -> FilePair:
    """The pair of one line; what is wrong with it is its ``error``."""
    shown = repr(given) if isinstance(given, RegnfError) else json.dumps(given, sort_keys=True)
    name = hashlib.sha256(f"{ENGINE_REVISION} {shown}".encode(errors="surrogateescape")).hexdigest()[:16]
    key = given.get("key") if isinstance(given, dict) and isinstance(given.get("key"), str) else None
    try:
        if isinstance(given, RegnfError):
            raise given
        if not isinstance(given, dict):
            raise _wrong("the line is no JSON object")
        _check_names(given)
        scene, objects = _fields(folder, given)
        return FilePair(line, name, key, scene, objects, "candidates" in given, _request(folder, given))
    except RegnfError as error:
        return FilePair(line, name, key, error=error)


def _check_names(given: Collection[str]) -> None:
    """Raises InvalidInputError (INVALID_REQUEST) for members that are unknown, or too few."""
    unknown = next((name for name in given if name not in _KNOWN), None)
    if unknown is not None:
        raise _wrong(f"unknown member `{unknown}`", suggestion(unknown, _KNOWN) or _HINT)
    missing = [name for name in ("scene", "detection") if name not in given]
    if missing or not {"object", "candidates"} & set(given):
        what = f"`{missing[0]}`" if missing else "`object` or `candidates`"
        raise _wrong(f"{what} is missing")


def _fields(folder: Path, given: Mapping[str, Any]) -> tuple[str, tuple[str, ...]]:
    """Scene and objects: files beside the list, or SHA-256s of fields that a service has."""
    if "candidates" in given and "object" in given:
        raise _wrong("`object` and `candidates` are both given, expected one of them")
    several = given["candidates"] if "candidates" in given else [given["object"]]
    if not (isinstance(several, list) and several):
        raise _wrong("`candidates` is no list of files")
    names = (given["scene"], *several)
    if not all(isinstance(name, str) for name in names):
        raise _wrong("the name of a field is not a text")
    paths = [(name, folder / name) for name in names]
    named = [name if _SHA256.fullmatch(name) and not path.exists() else str(path) for name, path in paths]
    return named[0], tuple(named[1:])


def _request(folder: Path, given: Mapping[str, Any]) -> dict[str, Any]:
    box = _value(folder, given["detection"])
    options, seed = _value(folder, given.get("options", {})), given.get("seed", 0)
    if not isinstance(options, dict):
        raise InvalidInputError("`options` is no object", reason="INVALID_OPTIONS", hint=_HINT)
    RegistrationOptions.from_dict(options)
    if not (isinstance(seed, int) and 0 <= seed < 2**32):
        raise _wrong("`seed` is no number from 0 to 2^32 - 1")
    if not isinstance(given.get("pictures", True), bool):
        raise _wrong("`pictures` is neither true nor false")
    detection = plain_values(read_detection(box, given.get("detection_index"), folder))
    more = {name: given[name] for name in _MORE if given.get(name) is not None}
    for name in {"initial_transform", "ground_truth"} & more.keys():
        more[name] = as_transform(_value(folder, more[name]), f"`{name}`")
    if "ground_truth" in more:
        more["ground_truth"] = {"T_object_scene": more["ground_truth"]}
    return {"detection": detection, "options": options, "seed": seed, **more}


def _value(folder: Path, given: Any) -> Any:
    """A value, or that of the JSON or the JSON file that a text is."""
    if not isinstance(given, str):
        return given
    if is_json(given):
        return json_value(given)
    try:
        return json_value((folder / given).read_bytes(), f"{given}: ")
    except OSError as error:
        raise InvalidInputError(f"{given}: {error.strerror}", reason="FILE_NOT_FOUND", hint=_HINT) from error


class ResultsFile:
    """Results, a JSON line each, appended as they come. A line that a killed process left unfinished is cut off.

    Raises InvalidInputError (RESULTS_UNREADABLE) for a file of something else, which is left as it is.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._last: dict[str, dict[str, Any]] = {}
        if path.exists():
            *lines, torn = path.read_bytes().split(b"\n")
            self._last = {told["id"]: told for told in self._read(lines)}
            if not (torn.startswith(_LINE_BEGINS) or _LINE_BEGINS.startswith(torn)):
                raise self._unreadable(len(lines) + 1)
            os.truncate(path, path.stat().st_size - len(torn))

    def is_done(self, pair: FilePair) -> bool:
        """Whether an earlier run has a result of it. What failed is done again."""
        return self._last.get(pair.id, {}).get("status") == "successful"

    def add(self, pair: FilePair, told: Mapping[str, Any]) -> None:
        line = {"id": pair.id, "line": pair.line, "key": pair.key, **told}
        self._last[pair.id] = line
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")

    def failures(self, pairs: list[FilePair]) -> dict[str, list[dict[str, Any]]]:
        """The lines of those that failed in this run, by reason, the most frequent one first."""
        found: dict[str, list[dict[str, Any]]] = {}
        for pair in pairs:
            told = self._last.get(pair.id, {})
            if "error" in told:
                found.setdefault(told["error"]["reason"], []).append({**told, "line": pair.line})
        return dict(sorted(found.items(), key=lambda one: -len(one[1])))

    def counts(self, pairs: list[FilePair]) -> Counter[str]:
        """How these pairs have ended: by verdict, or failed."""
        found = [self._last[pair.id] for pair in pairs if pair.id in self._last]
        return Counter(str(one.get("verdict") or one["status"]) for one in found)

    def _read(self, lines: Sequence[bytes]) -> Iterator[dict[str, Any]]:
        for number, text in enumerate(lines, 1):
            try:
                told = json.loads(text)
                yield {"id": told["id"], "status": told["status"], "verdict": told.get("verdict")}
            except (ValueError, KeyError, TypeError, RecursionError) as error:
                raise self._unreadable(number) from error

    def _unreadable(self, number: int) -> InvalidInputError:
        hint = "Give another file with --output, or delete this one."
        return InvalidInputError(f"{self._path}: line {number} is no result", reason="RESULTS_UNREADABLE", hint=hint)
