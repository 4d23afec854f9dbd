"""Many registrations in one request, and their results as they come."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import islice
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field

from regnf_client.answers import checked, refusal, service_error
from regnf_client.errors import ServiceError
from regnf_client.fields import Asking, Deadline, FieldLike, known_sha256, upload
from regnf_client.models import Alternative, Array, Document, Matrix, Verdict
from regnf_client.registrations import Request
from regnf_client.steps import Flow, call
from regnf_client.worker_watch import look
from regnf_core.detections.objects import BoxLike
from regnf_core.errors import InvalidInputError, RegnfError
from regnf_core.field_source import Role
from regnf_core.options import OptionsLike

PAIRS_AT_ONCE = 5000
"""More requests become several batches, one after the other."""
_LINES_AT_ONCE = 500
_OWN = ("scene", "object", "candidates", "detection", "options", "seed", "key")
_HEADERS = {"Content-Type": "application/x-ndjson"}


@dataclass(frozen=True)
class Pair:
    """One registration of many. object: or a list of candidates, among which the likeliest is searched · key: your name
    of it · more: further members of ``POST /register``, such as ``initial_transform``."""

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
            raise InvalidInputError("a pair is no object", reason="INVALID_REQUEST", hint=hint)
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
    """What became of one pair. index: its place among the requests, from 0 on · job: its id; ``client.result(it)`` has
    the whole result. error: what went wrong, unless ``status`` is ``successful``."""

    index: int
    key: str | None = None
    job: str | None = None
    status: Literal["successful", "failed", "refused"]
    verdict: Verdict | None = None
    verdict_reason: str | None = None
    probability: float | None = None
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


def parts_of(requests: Iterable[PairLike]) -> Iterator[list[tuple[int, PairLike]]]:
    """The requests with their places, as many at a time as one batch has."""
    numbered = iter(enumerate(requests))
    while part := list(islice(numbered, PAIRS_AT_ONCE)):
        yield part


class BatchReader:
    """One batch, from its requests to its last result. Call ``post``, then ``read`` until it says None."""

    def __init__(self, asking: Asking, part: list[tuple[int, PairLike]], deadline: Deadline) -> None:
        self._asking = asking
        self._part = part
        self._deadline = deadline
        self._sent: dict[tuple[str, str], str | RegnfError] = {}
        self._indexes: list[int] = []
        """Of the pairs that were posted."""
        self._id = ""
        self._after = 0
        self._pairs = 0
        self._ended = False

    def post(self) -> Flow[list[PairResult]]:
        """Upload what the service lacks and post the pairs; the results that are known at once: pairs that could not be
        posted, and what an earlier call has left."""
        lines, refused = [], []
        for index, given in self._part:
            try:
                pair = Pair.of(given)
                lines.append(json.dumps((yield from self._line(pair))).encode())
                self._indexes.append(index)
            except RegnfError as error:
                if getattr(error, "unavailable", False) or error.reason == "UNAUTHENTICATED":
                    raise
                refused.append(PairResult(index=index, key=_key_of(given), status="refused", error=error))
        if not lines:
            self._ended = True
            return refused
        content = b"\n".join(lines)
        answer = yield from call(self._asking.patience, "POST", "/batches", content=content, headers=_HEADERS)
        document = checked(answer)
        self._id, self._pairs = document["id"], document["pairs"]
        if document["passes"] > 1:
            refused += yield from self._earlier(document)
        return refused

    def _earlier(self, document: Mapping[str, Any]) -> Flow[list[PairResult]]:
        """What is left of the passes before this one: failed pairs are repeated now."""
        last: dict[int, PairResult] = {}
        while self._after < document["results"]:
            for one in (yield from self._fetch(wait_s=0, limit=document["results"] - self._after)):
                last[one.index] = one
        goes_on = document["status"] == "running"
        return [one for one in last.values() if not (goes_on and one.status == "failed")]

    def read(self) -> Flow[list[PairResult] | None]:
        """The next results, some or none; None after the last. Raises WaitTimeoutError, ServiceError (CANCELLED)."""
        if self._ended:
            return None
        found = yield from self._fetch(self._deadline.hold_s(), _LINES_AT_ONCE)
        self._asking.tell("registering", min(1.0, self._after / self._pairs))
        if not found and not self._ended:
            self._deadline.check(f"the batch {self._id}")
            yield from look(self._asking.watch, self._asking.patience)
        return found

    def _fetch(self, wait_s: int, limit: int) -> Flow[list[PairResult]]:
        params = {"after": self._after, "limit": limit, "wait": wait_s}
        answer = yield from call(self._asking.patience, "GET", f"/batches/{self._id}/results", params=params)
        if not answer.is_success:
            raise refusal(answer)
        found = [self._result(json.loads(line)) for line in answer.text.splitlines()]
        status = answer.headers.get("batch-status")
        if not found and status == "dismissed":
            raise ServiceError(f"the batch {self._id} was cancelled", reason="CANCELLED", hint="Post it again.")
        self._ended = not found and status != "running"
        return found

    def _result(self, told: dict[str, Any]) -> PairResult:
        self._after = told["number"]
        return PairResult.model_validate({**told, "index": self._indexes[told["pair"] - 1]})

    def _line(self, pair: Pair) -> Flow[dict[str, Any]]:
        body = Request(pair.detection, pair.options, pair.seed, more=pair.more).body()
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
        name = (str(getattr(one, "named", one)), role)
        if name not in self._sent:
            try:
                self._sent[name] = (yield from upload(self._asking, one, role)).sha256
            except RegnfError as error:
                if getattr(error, "unavailable", False):
                    raise
                self._sent[name] = error
        found = self._sent[name]
        if isinstance(found, RegnfError):
            raise found
        return found


def _key_of(given: PairLike) -> str | None:
    key = given.key if isinstance(given, Pair) else given.get("key") if isinstance(given, Mapping) else None
    return key if isinstance(key, str) else None
