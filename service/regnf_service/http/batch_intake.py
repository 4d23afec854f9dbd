"""Taking a batch in: each line is checked by itself, and what is wrong with one refuses no other."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from typing import Any

from regnf_core.engine_revision import ENGINE_REVISION
from regnf_service.batches.feeder import Requests
from regnf_service.http.batch_lines import LINE_BYTES, Line
from regnf_service.http.by_reference import Library, asked_by_reference
from regnf_service.http.problems import problem_of
from regnf_service.http.schemas.batches import BatchPair
from regnf_service.http.schemas.reading import read_model
from regnf_service.http.schemas.registrations import RegisterRequest
from regnf_service.http.strict_json import parse_json
from regnf_service.jobs.cost_limits import check_cost
from regnf_service.problem import CLOSE, Problem
from regnf_service.services import Services
from regnf_state.batch_records import Batch, Pair, pair_text
from regnf_state.blobs.base import BlobWriter
from regnf_state.registration_request import RegistrationRequest

_ID_DIGITS = 32
_PROBLEMS_SHOWN = 32


def read_again(services: Services, caller: str, request: dict[str, Any]) -> tuple[RegistrationRequest, dict[str, str]]:
    """A kept line's request, and the fields that it names. Raises Problem."""
    return asked_by_reference(Library(services, caller), read_model(RegisterRequest, json.dumps(request).encode()))


REQUESTS = Requests(read_again, problem_of)
"""What the feeder is given."""


class Intake:
    """Reads the lines of one batch into ``pairs``. Blocking. Its memory does not grow with the lines, but for keys."""

    def __init__(self, services: Services, caller: str, pairs: BlobWriter) -> None:
        self._services = services
        self._caller = caller
        self._pairs = pairs
        self._library = Library(services, caller)
        self._count = 0
        self._refused = 0
        self._problems: list[dict[str, Any]] = []
        self._keys: dict[str, int] = {}
        self._identity = hashlib.sha256(f"batch {ENGINE_REVISION}\n".encode())

    def take(self, lines: Sequence[Line]) -> None:
        """Check these lines and write them down. Raises Problem TOO_MANY_PAIRS, OSError."""
        most = self._services.settings.max_batch_pairs
        for line in lines:
            self._count += 1
            if self._count > most:
                raise Problem("TOO_MANY_PAIRS", f"A batch has at most {most} lines.", headers=CLOSE)
            self._pairs.write(pair_text(self._pair(line)))

    def finish(self, created: float) -> Batch:
        """The batch of all lines. Raises Problem BATCH_EMPTY."""
        if not self._count:
            raise Problem("BATCH_EMPTY")
        batch_id = self._identity.hexdigest()[:_ID_DIGITS]
        return Batch(batch_id, self._caller, created, self._count, self._refused, self._problems)

    def _pair(self, line: Line) -> Pair:
        try:
            key, asked, request = self._read(line)
        except Problem as problem:
            error = problem.document()
            self._refused += 1
            if len(self._problems) < _PROBLEMS_SHOWN:
                self._problems.append({"line": line.number, "error": error})
            self._identify([hashlib.sha256(line.text or b"").hexdigest(), error["reason"]])
            return Pair(self._count, line.number, 0, None, None, error)
        self._keys.update({key: line.number} if key is not None else {})
        self._identify([key, asked.values()])
        return Pair(self._count, line.number, 0, key, request)

    def _read(self, line: Line) -> tuple[str | None, RegistrationRequest, dict[str, Any]]:
        """The line's key and request, and what is kept of it: entries of the library are taken as they are now.

        Raises Problem: what POST /register would say.
        """
        if line.text is None:
            raise Problem("LINE_TOO_LARGE", f"A line may have {LINE_BYTES} bytes.")
        spec = read_model(BatchPair, line.text)
        if spec.key is not None and spec.key in self._keys:
            fault = {"pointer": "/key", "detail": f"Line {self._keys[spec.key]} has the same key."}
            raise Problem("INVALID_REQUEST", errors=[fault])
        asked, _ = asked_by_reference(self._library, spec)
        self._check(asked)
        members = {name: value for name, value in parse_json(line.text).items() if name != "key"}
        meant = {"object": asked.object, "candidates": asked.candidates and list(asked.candidates)}
        return spec.key, asked, members | {name: value for name, value in meant.items() if value is not None}

    def _check(self, asked: RegistrationRequest) -> None:
        check_cost(self._services.settings, asked)
        self._services.webhooks.check(self._caller, asked.webhook)

    def _identify(self, value: Any) -> None:
        text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
        self._identity.update(text.encode() + b"\n")
