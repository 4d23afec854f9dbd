"""Taking a batch in: each line is read by itself, and what is wrong with one refuses no other."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from regnf_core.engine_revision import ENGINE_REVISION
from regnf_service.batches import Line, Posting
from regnf_service.http.batch_lines import LINE_BYTES, TextLine
from regnf_service.http.by_reference import Library, asked_by_reference
from regnf_service.http.schemas.batches import BatchPair
from regnf_service.http.schemas.reading import read_model
from regnf_service.problem import CLOSE, Problem
from regnf_service.services import Services

_ID_DIGITS = 32
_LINES_AT_ONCE = 50
_BYTES_AT_ONCE = 64 * 1024
Read = tuple[Line, TextLine, BatchPair | None]


def portions(lines: Iterable[TextLine]) -> Iterator[list[TextLine]]:
    """A few at a time, so that other callers' requests are read in between."""
    few: list[TextLine] = []
    size = 0
    for line in lines:
        few.append(line)
        size += len(line.text or b"")
        if len(few) == _LINES_AT_ONCE or size >= _BYTES_AT_ONCE:
            yield few
            few, size = [], 0
    if few:
        yield few


class Intake:
    """Reads the lines of one batch. Blocking: ``read`` needs no store, ``take`` does. The library is looked up once."""

    def __init__(self, services: Services, caller: str) -> None:
        self._services = services
        self._caller = caller
        self.library = Library(services, caller)
        self._lines: list[Line] = []
        self._keys: dict[str, int] = {}
        self._count = 0
        self._identity = hashlib.sha256(f"batch {ENGINE_REVISION} {caller}\n".encode())

    def read(self, texts: Sequence[TextLine]) -> list[Read]:
        """These lines as requests; with an error those that are none. Raises Problem TOO_MANY_PAIRS."""
        most = self._services.settings.max_batch_pairs
        self._count += len(texts)
        if self._count > most:
            extra = {"fitting_lines": most}
            raise Problem("TOO_MANY_PAIRS", f"A batch has at most {most} lines.", headers=CLOSE, extra=extra)
        return [self._read(text) for text in texts]

    def take(self, read: Sequence[Read]) -> None:
        """Find the objects that the requests mean, and keep the lines."""
        for line, text, spec in read:
            if spec is not None:
                try:
                    line.asked, line.named = asked_by_reference(self.library, spec)
                except Problem as problem:
                    line.error = problem.document()
            if line.asked is not None:
                self._identify([line.key, line.asked.values()])
            else:
                self._identify([hashlib.sha256(text.text or b"").hexdigest(), (line.error or {}).get("reason")])
            self._lines.append(line)

    def finish(self) -> Posting:
        """All lines, to become jobs. Raises Problem BATCH_EMPTY."""
        if not self._lines:
            raise Problem("BATCH_EMPTY")
        return Posting(self._services, self._caller, self._identity.hexdigest()[:_ID_DIGITS], self._lines)

    def _read(self, text: TextLine) -> Read:
        line = Line(text.number)
        try:
            spec = self._spec(text)
        except Problem as problem:
            line.error = problem.document()
            return line, text, None
        line.key = spec.key
        return line, text, spec

    def _spec(self, text: TextLine) -> BatchPair:
        """Raises Problem: what POST /register would say."""
        if text.text is None:
            raise Problem("LINE_TOO_LARGE", f"A line may have {LINE_BYTES} bytes.")
        spec = read_model(BatchPair, text.text)
        if spec.key is not None and self._keys.setdefault(spec.key, text.number) != text.number:
            fault = {"pointer": "/key", "detail": f"Line {self._keys[spec.key]} has the same key."}
            raise Problem("INVALID_REQUEST", errors=[fault])
        return spec

    def _identify(self, value: Any) -> None:
        text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
        self._identity.update(text.encode() + b"\n")
