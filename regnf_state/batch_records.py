"""What is kept of a batch: a head that never changes, and a state with which each block of its results begins."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import Any, Literal, NamedTuple

from pydantic import TypeAdapter, ValidationError

from regnf_state.record_format import FORMAT, check_json_format
from regnf_state.records import UnreadableRecordError

BatchStatus = Literal["running", "finished", "dismissed"]
COUNTED = ("registered", "ambiguous", "rejected", "failed", "refused")
"""How a pair can end: a verdict, an error of its job or fields, or an error of its line."""


class BatchName(NamedTuple):
    """Which batch it is: each caller has its own."""

    owner: str
    id: str


@dataclass(frozen=True)
class Batch:
    """One batch as it was posted. refused: lines that are no request; problems: the first of their errors."""

    id: str
    owner: str
    created: float
    pairs: int
    refused: int = 0
    problems: list[dict[str, Any]] = field(default_factory=list)

    @property
    def name(self) -> BatchName:
        return BatchName(self.owner, self.id)


@dataclass(frozen=True)
class Pair:
    """One line of a batch. number: from 1 on · line: in the body, from 1 on · offset, end: where it is kept.

    request: as POST /register takes it; None where the line is none, and ``error`` says why.
    """

    number: int
    line: int
    offset: int
    key: str | None
    request: dict[str, Any] | None
    error: dict[str, Any] | None = None
    end: int = 0


@dataclass(frozen=True)
class OpenPair:
    """A pair that was looked at and whose result is not written yet. job: "" where there is none, then ``error``.

    started: whether this batch has started the job, so that cancelling it stops the job · tries: how often it was ·
    stopped: whether it was stopped, so that it is started again if the batch goes on.
    """

    number: int
    offset: int
    job: str = ""
    started: bool = False
    tries: int = 1
    stopped: bool = False
    error: dict[str, Any] | None = None


@dataclass(frozen=True)
class BatchState:
    """Where a batch is. block: the number of the block of results that says so · lines: of results, in all blocks.

    A batch that is posted again after its end does its failed pairs in a further pass: ``todo`` has a bit for each of
    them, hexadecimal. since: when the pass, or what goes on of it, began.
    """

    since: float
    updated: float
    status: BatchStatus = "running"
    block: int = 0
    lines: int = 0
    next: int = 1
    offset: int = 0
    """Of the next pair to look at, in the kept pairs."""
    open: list[OpenPair] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)
    passes: int = 1
    todo: str | None = None
    finished: float | None = None
    waits_for: str | None = None
    """Why no further pair is handed out now: the reason of a limit."""

    def wants(self, number: int) -> bool:
        """Whether this pass does the pair."""
        return self.todo is None or bool(int(self.todo, 16) >> number & 1)


_HEAD: TypeAdapter[Batch] = TypeAdapter(Batch)
_STATE: TypeAdapter[BatchState] = TypeAdapter(BatchState)


def head_text(batch: Batch) -> bytes:
    return _text(asdict(batch))


def state_text(state: BatchState) -> bytes:
    return _text(asdict(state))


def pair_text(pair: Pair) -> bytes:
    """A line of the kept pairs. Its number and offset follow from its place."""
    return _line({"line": pair.line, "key": pair.key, "request": pair.request, "error": pair.error})


def read_head(name: BatchName, text: bytes) -> Batch:
    """Raises UnreadableRecordError."""
    head: Batch = _read(_HEAD, name.id, text)
    return head


def read_state(batch_id: str, text: bytes) -> BatchState:
    """Raises UnreadableRecordError."""
    state: BatchState = _read(_STATE, batch_id, text)
    return state


def read_pair(batch_id: str, number: int, offset: int, text: bytes) -> Pair:
    """Raises UnreadableRecordError."""
    try:
        held = json.loads(text)
        return Pair(number, held["line"], offset, held["key"], held["request"], held["error"], offset + len(text))
    except (ValueError, KeyError, TypeError) as error:
        raise UnreadableRecordError(batch_id, f"pair {number} is damaged") from error


def _read(adapter: TypeAdapter[Any], name: str, text: bytes) -> Any:
    try:
        document = check_json_format(name, json.loads(text))
        return adapter.validate_python({key: value for key, value in document.items() if key != "format"})
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        raise UnreadableRecordError(name, f"{'.'.join(map(str, first['loc']))}: {first['type']}") from error
    except (ValueError, RecursionError) as error:
        raise UnreadableRecordError(name, "it is not JSON") from error


def _text(document: dict[str, Any]) -> bytes:
    return _line(document | {"format": FORMAT})


def _line(document: dict[str, Any]) -> bytes:
    return json.dumps(document, separators=(",", ":")).encode() + b"\n"
