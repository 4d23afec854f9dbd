"""Many registrations in one request, and their results as they become available."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field

from regnf_client.answers import checked, object_of, refusal, service_error
from regnf_client.fields import FieldLike, known_sha256, upload
from regnf_client.models import Alternative, Array, Document, Matrix
from regnf_client.recordings import detection_body
from regnf_client.steps import Asking, Deadline, Flow, Pause, retry_after_s
from regnf_core.detections.parsing import BoxLike
from regnf_core.document import Verdict
from regnf_core.errors import InvalidInputError, RegnfError
from regnf_core.field_source import FieldSource, Role
from regnf_core.options import Acceptance, OptionsLike, options_of

PAIRS_AT_ONCE = 500
_BYTES_AT_ONCE = 4 << 20
"""More requests become several batches, one after the other: the service takes a thousand lines, of 8 MiB."""
_OWN = ("scene", "object", "candidates", "detection", "options", "seed", "key")
_LONGEST_PAUSE_S = 60.0
_HEADERS = {"Content-Type": "application/x-ndjson"}


@dataclass(frozen=True)
class Pair:
    """One registration of many. object: the object, or a list of candidates to search · key: your own name of the pair
    · more: further members of ``POST /register``, such as ``initial_transform``."""

    scene: FieldLike
    object: FieldLike | list[FieldLike]
    detection: BoxLike
    options: OptionsLike = None
    seed: int = 0
    key: str | None = None
    more: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, given: PairLike) -> Pair:
        """A pair, or the members of a request. Raises InvalidInputError (INVALID_REQUEST)."""
        if isinstance(given, Pair):
            return given
        hint = 'Write {"scene": ..., "object": ..., "detection": ...}.'
        if not isinstance(given, Mapping):
            raise InvalidInputError("a pair is no JSON object", reason="INVALID_REQUEST", hint=hint)
        objects = given.get("object", given.get("candidates"))
        if "scene" not in given or objects is None or "detection" not in given:
            raise InvalidInputError(
                "a pair lacks `scene`, `object` or `detection`", reason="INVALID_REQUEST", hint=hint
            )
        known = {name: given[name] for name in ("options", "seed", "key") if name in given}
        more = {name: value for name, value in given.items() if name not in _OWN}
        return cls(given["scene"], objects, given["detection"], more=more, **known)


PairLike = Pair | Mapping[str, Any]


def _error(value: Any) -> RegnfError | None:
    return service_error(value) if isinstance(value, Mapping) else value


class PairResult(Document):
    """The outcome of one pair. index: its position among the requests, from 0 · job: the id of its job;
    ``client.result(job)`` returns the full result · error: the failure; None if ``status`` is ``successful``."""

    index: int
    key: str | None = None
    job: str | None = None
    status: Literal["successful", "failed", "refused"]
    verdict: Verdict | None = None
    verdict_reason: str | None = None
    probability: float | None = None
    level: Acceptance | None = None
    T_scene_object: Matrix | None = None
    T_object_scene: Matrix | None = None
    center_scene: Array | None = None
    uncertainty: dict[str, Any] | None = None
    alternatives: list[Alternative] = Field(default_factory=list)
    metrics: dict[str, float | None] = Field(default_factory=dict)
    object: str | None = None
    error: Annotated[RegnfError | None, BeforeValidator(_error)] = None

    @property
    def scale(self) -> float | None:
        """Object units per scene unit."""
        if self.T_object_scene is None:
            return None
        return float(np.cbrt(np.linalg.det(self.T_object_scene[:3, :3])))

    def __repr__(self) -> str:
        name = self.key if self.key is not None else self.index
        return f"PairResult({name}: {self.verdict or (self.error.reason if self.error else self.status)})"


def request_body(
    detection: BoxLike,
    options: OptionsLike = None,
    seed: int = 0,
    initial_transform: Any = None,
    more: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """The request of a registration without its fields, as it is sent. initial_transform: a T_object_scene, or
    ``{"T_scene_object": ...}``. Raises InvalidDetectionError and InvalidOptionsError."""
    body = {
        "detection": detection_body(detection),
        "options": None if options is None else options_of(options).to_dict(),
        "seed": seed,
        "initial_transform": plain(initial_transform),
        **(more or {}),
    }
    return {name: value for name, value in body.items() if value is not None}


def plain(value: Any) -> Any:
    """JSON values: arrays and tuples become lists, boxes become detections, transforms become matrices."""
    if isinstance(value, Mapping):
        return {str(name): plain(part) for name, part in value.items()}
    if hasattr(value, "to_detection"):
        return value.to_detection().canonical()
    if callable(getattr(value, "matrix", None)):
        return plain(value.matrix())
    if hasattr(value, "tolist"):
        return value.tolist()
    return [plain(part) for part in value] if isinstance(value, list | tuple) else value


class BatchReader:
    """Any number of requests with their results, as several batches one after the other.

    Call ``post``, then ``read`` until it returns None. Repeat until ``post`` returns None. The same request twice is
    one job, so the same requests can be posted again after an interruption.
    """

    def __init__(self, asking: Asking, requests: Iterable[PairLike], deadline: Deadline) -> None:
        self._asking = asking
        self._requests = enumerate(requests)
        self._deadline = deadline
        self._sent: dict[tuple[str, str], str | RegnfError] = {}
        self._in_memory: list[FieldLike] = []
        self._lines: list[tuple[int, bytes]] = []
        """Lines that are not posted yet, with the places of their requests."""
        self._indexes: list[int] = []
        """Of the pairs that were posted last."""
        self._id = ""
        self._after = 0
        self._read = 0

    def post(self) -> Flow[list[PairResult] | None]:
        """Upload missing files and post the next pairs. Returns the results of pairs that could not be posted; None
        after the last. If the service cannot accept all of them, as many as it can accept are posted."""
        refused = yield from self._fill()
        if not self._lines:
            return refused or None
        lines = self._lines
        while True:
            content = b"\n".join(line for _, line in lines)
            answer = yield from self._asking.call("POST", "/batches", content=content, headers=_HEADERS)
            # how many of the first lines the service has room for, where it has none for all of them
            fitting = None if answer.is_success else (object_of(answer) or {}).get("fitting_lines")
            if not isinstance(fitting, int):
                break
            lines = self._lines[: fitting or None]
            if fitting == 0:
                self._deadline.check("room for the next pairs")
                yield from self._asking.look()
                after = retry_after_s(answer)
                yield Pause(1.0 if after is None else min(_LONGEST_PAUSE_S, after))
        self._id, pairs = checked(answer)["id"], checked(answer)["pairs"]
        self._indexes = [index for index, _ in self._lines[:pairs]]
        self._lines, self._after = self._lines[pairs:], 0
        return refused

    def _fill(self) -> Flow[list[PairResult]]:
        """Take requests until there are as many lines as one batch has; the results of those that cannot be posted."""
        refused = []
        size = sum(len(line) for _, line in self._lines)
        while len(self._lines) < PAIRS_AT_ONCE and size < _BYTES_AT_ONCE:
            following = next(self._requests, None)
            if following is None:
                break
            index, given = following
            try:
                line = json.dumps((yield from self._line(Pair.of(given)))).encode()
                self._lines.append((index, line))
                size += len(line)
            except RegnfError as error:
                if getattr(error, "unavailable", False) or error.reason == "UNAUTHENTICATED":
                    raise
                refused.append(PairResult(index=index, key=_key_of(given), status="refused", error=error))
        return refused

    def read(self) -> Flow[list[PairResult] | None]:
        """The next results, possibly none; None after the last result of the posted requests. Raises
        WaitTimeoutError."""
        if self._after >= len(self._indexes):
            return None
        params = {"after": self._after, "wait": self._deadline.hold_s()}
        answer = yield from self._asking.call("GET", f"/batches/{self._id}/results", params=params)
        if not answer.is_success:
            raise refusal(answer)
        found = [self._result(json.loads(line)) for line in answer.text.splitlines()]
        self._read += len(found)
        known = self._read + len(self._indexes) - self._after + len(self._lines)
        self._asking.tell("registering", self._read / max(1, known))
        if not found:
            self._deadline.check(f"the batch {self._id}")
            yield from self._asking.look()
        return found

    def _result(self, told: dict[str, Any]) -> PairResult:
        self._after = told["number"]
        return PairResult.model_validate({**told, "index": self._indexes[told["number"] - 1]})

    def _line(self, pair: Pair) -> Flow[dict[str, Any]]:
        body = request_body(pair.detection, pair.options, pair.seed, more=pair.more)
        scene = yield from self._upload(pair.scene, "scene")
        named: dict[str, Any] = {"scene": scene} | ({} if pair.key is None else {"key": pair.key})
        if isinstance(pair.object, list):
            named["candidates"] = []
            for one in pair.object:
                named["candidates"].append((yield from self._upload(one, "object")))
        else:
            named["object"] = yield from self._upload(pair.object, "object")
        return named | body

    def _upload(self, one: FieldLike, role: Role) -> Flow[str]:
        """The SHA-256 of a field, which is sent once for all pairs. Raises RegnfError, for each of them."""
        known = known_sha256(one)
        if known is not None:
            return known  # pairs of fields that the service lacks fail one by one
        in_memory = not isinstance(one, str | os.PathLike | FieldSource)
        name = (f"{id(one)}" if in_memory else str(getattr(one, "named", one)), role)
        if name not in self._sent:
            try:
                self._sent[name] = (yield from upload(self._asking, one, role)).sha256
            except RegnfError as error:
                if getattr(error, "unavailable", False):
                    raise
                self._sent[name] = error
            self._in_memory += [one] if in_memory else []  # as long as it is there, no other has its number
        found = self._sent[name]
        if isinstance(found, RegnfError):
            raise found
        return found


def _key_of(given: PairLike) -> str | None:
    key = given.key if isinstance(given, Pair) else given.get("key") if isinstance(given, Mapping) else None
    return key if isinstance(key, str) else None
