"""The files of `regnf batch`: pairs to be registered, and the results so far."""

from __future__ import annotations

import csv
import hashlib
import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from regnf_core.detections import parse_detection
from regnf_core.engine_revision import ENGINE_REVISION
from regnf_core.errors import InvalidInputError, RegnfError
from regnf_core.hints import suggestion
from regnf_core.json_faults import json_fault
from regnf_core.options import RegistrationOptions

MEMBERS = ("key", "scene", "object", "candidates", "detection", "detection_index", "options", "seed")
_MORE = ("initial_transform", "ground_truth", "pictures")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_HINT = 'Write {"scene": FILE, "object": FILE, "detection": BOX or FILE} on each line.'


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


def read_pairs(path: Path) -> Iterator[FilePair]:
    """The pairs of a JSON Lines file, or of a CSV file with the members' names in its first line."""
    lines = _csv_lines(path) if path.suffix.lower() == ".csv" else _json_lines(path)
    for number, given in lines:
        yield _pair(path.resolve().parent, number, given)


def _csv_lines(path: Path) -> Iterator[tuple[int, Any]]:
    with path.open(encoding="utf-8", newline="") as file:
        rows = csv.DictReader(file)
        for row in rows:
            given: dict[str, Any] = {name: value for name, value in row.items() if value not in (None, "")}
            for name in ("seed", "detection_index", "pictures"):
                if re.fullmatch(r"0|[1-9]\d*|true|false", str(given.get(name, ""))):
                    given[name] = json.loads(given[name])
            yield rows.line_num, given


def _json_lines(path: Path) -> Iterator[tuple[int, Any]]:
    with path.open(encoding="utf-8", errors="surrogateescape") as file:
        for number, text in enumerate(file, 1):
            if not text.strip():
                continue
            try:
                yield number, json.loads(text)
            except json.JSONDecodeError as error:
                message, hint = json_fault(error)
                yield number, InvalidInputError(f"the line is {message}", reason="MALFORMED_JSON", hint=hint)
            except (ValueError, RecursionError):
                yield number, InvalidInputError("the line is no JSON", reason="MALFORMED_JSON", hint=_HINT)


def _pair(folder: Path, line: int, given: Any) -> FilePair:
    """The pair of one line; what is wrong with it is its ``error``."""
    shown = repr(given) if isinstance(given, RegnfError) else json.dumps(given, sort_keys=True)
    name = hashlib.sha256(f"{ENGINE_REVISION} {shown}".encode(errors="surrogateescape")).hexdigest()[:16]
    key = given.get("key") if isinstance(given, dict) and isinstance(given.get("key"), str) else None
    try:
        if isinstance(given, RegnfError):
            raise given
        scene, objects = _fields(folder, _members(given))
        return FilePair(line, name, key, scene, objects, "candidates" in given, _request(folder, given))
    except RegnfError as error:
        return FilePair(line, name, key, error=error)


def _members(given: Any) -> dict[str, Any]:
    if not isinstance(given, dict):
        raise InvalidInputError("the line is no object", reason="INVALID_REQUEST", hint=_HINT)
    known = (*MEMBERS, *_MORE)
    unknown = next((name for name in given if name not in known), None)
    if unknown is not None:
        hint = suggestion(str(unknown), known) or _HINT
        raise InvalidInputError(f"no member `{unknown}` is known", reason="INVALID_REQUEST", hint=hint)
    missing = [name for name in ("scene", "detection") if name not in given]
    if missing or ("object" in given) == ("candidates" in given):
        what = f"`{missing[0]}`" if missing else "either `object` or `candidates`"
        raise InvalidInputError(f"the line lacks {what}", reason="INVALID_REQUEST", hint=_HINT)
    return given


def _fields(folder: Path, given: Mapping[str, Any]) -> tuple[str, tuple[str, ...]]:
    several = given["candidates"] if "candidates" in given else [given["object"]]
    if not (isinstance(several, list) and several):
        raise InvalidInputError("`candidates` is no list of files", reason="INVALID_REQUEST", hint=_HINT)
    named = [_field(folder, one) for one in (given["scene"], *several)]
    return named[0], tuple(named[1:])


def _field(folder: Path, name: Any) -> str:
    """A file beside the list, or the SHA-256 of a field that a service has."""
    if not isinstance(name, str):
        raise InvalidInputError("a field is named by something else than a text", reason="INVALID_REQUEST", hint=_HINT)
    path = folder / name
    return name if _SHA256.fullmatch(name) and not path.exists() else str(path)


def _request(folder: Path, given: Mapping[str, Any]) -> dict[str, Any]:
    box = _value(folder, given["detection"])
    options, seed = _value(folder, given.get("options", {})), given.get("seed", 0)
    if not isinstance(options, dict):
        raise InvalidInputError("`options` is no object", reason="INVALID_OPTIONS", hint=_HINT)
    RegistrationOptions.from_dict(options)
    if not (isinstance(seed, int) and 0 <= seed < 2**32):
        raise InvalidInputError("`seed` is no number from 0 to 2^32 - 1", reason="INVALID_REQUEST", hint=_HINT)
    if not isinstance(given.get("pictures", True), bool):
        raise InvalidInputError("`pictures` is neither true nor false", reason="INVALID_REQUEST", hint=_HINT)
    detection = parse_detection(box, given.get("detection_index")).canonical()
    more = {name: given[name] for name in _MORE if given.get(name) is not None}
    return {"detection": detection, "options": options, "seed": seed, **more}


def _value(folder: Path, given: Any) -> Any:
    """A value, or that of the JSON file that it names."""
    if not isinstance(given, str):
        return given
    try:
        return json.loads((folder / given).read_text(encoding="utf-8"))
    except OSError as error:
        raise InvalidInputError(f"{given}: {error.strerror}", reason="FILE_NOT_FOUND", hint=_HINT) from error
    except ValueError as error:
        raise InvalidInputError(f"{given}: no JSON", reason="MALFORMED_JSON", hint=_HINT) from error


class ResultsFile:
    """Results, a JSON line each, appended as they come. A line that a killed process left unfinished is cut off."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._cut_torn_line()
        self._last = {told["id"]: told for told in self._lines()}

    def is_done(self, pair: FilePair) -> bool:
        """Whether an earlier run has a result of it. What failed is done again."""
        return self._last.get(pair.id, {}).get("status") == "successful"

    def add(self, pair: FilePair, told: Mapping[str, Any]) -> None:
        """Append the result of a pair."""
        line = {"id": pair.id, "line": pair.line, "key": pair.key, **told}
        self._last[pair.id] = line
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")

    def counts(self, pairs: list[FilePair]) -> Counter[str]:
        """How these pairs have ended: by verdict, or failed."""
        found = [self._last[pair.id] for pair in pairs if pair.id in self._last]
        return Counter(str(one.get("verdict") or one["status"]) for one in found)

    def _lines(self) -> Iterator[dict[str, Any]]:
        if not self._path.exists():
            return
        with self._path.open(encoding="utf-8") as file:
            for number, text in enumerate(file, 1):
                try:
                    told = json.loads(text)
                    yield {"id": told["id"], "status": told["status"], "verdict": told.get("verdict")}
                except (ValueError, KeyError, TypeError) as error:
                    raise InvalidInputError(
                        f"{self._path}: line {number} is no result",
                        reason="RESULTS_UNREADABLE",
                        hint="Name another file with --output, or delete this one.",
                    ) from error

    def _cut_torn_line(self) -> None:
        if not self._path.exists():
            return
        with self._path.open("rb+") as file:
            end = file.seek(0, 2)
            while end > 0:
                start = max(0, end - 4096)
                file.seek(start)
                place = file.read(end - start).rfind(b"\n")
                if place >= 0:
                    file.truncate(start + place + 1)
                    return
                end = start
            file.truncate(0)
