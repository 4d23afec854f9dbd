"""What a service answers, typed. Members that this release does not know are kept: ``model_extra``."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, BeforeValidator, ConfigDict, PlainSerializer
from pydantic import Field as MemberField

from regnf_core.document import (
    AlternativeDocument,
    ArtifactEntry,
    CandidateDocument,
    ResultDocument,
    Verdict,
    sure_in_words,
)
from regnf_core.errors import RegnfError
from regnf_core.options import Acceptance

Floats = NDArray[np.float64]
Status = Literal["accepted", "running", "successful", "failed", "dismissed"]
FINISHED = frozenset({"successful", "failed", "dismissed"})


def _matrix(value: Any) -> Floats:
    """(4, 4) of a transform's document."""
    return _array(value["matrix"] if isinstance(value, dict) else value)


def _array(value: Any) -> Floats:
    return np.asarray(value, dtype=np.float64)  # None becomes NaN


_PLAIN = PlainSerializer(lambda array: array.tolist(), return_type=list)
Matrix = Annotated[Floats, BeforeValidator(_matrix), _PLAIN]
Array = Annotated[Floats, BeforeValidator(_array), _PLAIN]


class Document(BaseModel):
    """Base of all documents of the service."""

    model_config = ConfigDict(extra="allow", frozen=True, arbitrary_types_allowed=True)

    def __str__(self) -> str:
        return repr(self)


class Field(Document):
    """A field on the service. Only a ``ready`` field can be registered. It can be used in place of a path."""

    sha256: str
    state: Literal["validating", "ready", "rejected"]
    bytes: int
    label: str | None = None
    description: dict[str, Any] = {}
    settings: dict[str, Any] | None = None
    report: dict[str, Any] = {}
    error: dict[str, Any] | None = None
    kept_until: str | None = None

    def __repr__(self) -> str:
        return f"Field({self.sha256[:12]}…, {self.state}, {self.bytes / 1e6:.1f} MB)"


class Entry(Document):
    """An object of the library. It can be used in place of a path. field: the SHA-256 of its field."""

    name: str
    field: str
    state: Literal["validating", "ready", "rejected"]
    tags: list[str] = []
    unit: str | None = None
    note: str | None = None
    symmetry: dict[str, Any] | None = None
    symmetry_source: Literal["said", "detected"] | None = None
    bounds: Any = None
    surface_bounds: Any = None

    def __repr__(self) -> str:
        tags = f", {', '.join(self.tags)}" if self.tags else ""
        return f"Entry({self.name}{tags}, {self.state})"


class Job(Document):
    """The state of a job at the time of the request."""

    id: str
    kind: Literal["registration", "render"]
    status: Status
    phase: str | None = None
    progress: float = 0.0
    queue_position: int | None = None
    verdict: Verdict | None = None
    probability: float | None = None
    level: Acceptance | None = None
    object_found: str | None = None
    error: dict[str, Any] | None = None
    warnings: dict[str, list[str]] = {}
    links: dict[str, str] = {}
    sources: dict[str, str] = {}
    """The objects as the caller gave them, by the SHA-256 of their fields, for a job that this client submitted."""

    @property
    def finished(self) -> bool:
        """Whether the job has ended."""
        return self.status in FINISHED

    def __repr__(self) -> str:
        found = f", {self.verdict}" if self.verdict else ""
        return f"Job({self.id}, {self.kind}, {self.status}{found}, {100 * self.progress:.0f} %)"


class Event(Document):
    """One event of a job: ``status`` or ``progress``."""

    id: str
    name: str
    data: dict[str, Any]


class Artifact(Document, ArtifactEntry):
    """A file of a result. A ``pending`` file is still being made: its download waits until it is finished."""


class Alternative(Document, AlternativeDocument):
    """Another pose that matches the data equally well."""

    T_scene_object: Matrix  # type: ignore[assignment]
    T_object_scene: Matrix  # type: ignore[assignment]


class Candidate(Document, CandidateDocument):
    """The result of a search for one object. source: the object as the caller gave it."""

    T_scene_object: Matrix | None = None  # type: ignore[assignment]
    T_object_scene: Matrix | None = None  # type: ignore[assignment]
    source: str | None = None


class Result(Document, ResultDocument):
    """The result of a registration or a search: the members of ``regnf_core.document.ResultDocument``, and those below.

    Transforms are (4, 4) arrays, x -> s R x + t · center_scene: (3,) · covariance: (7, 7) · job: its id · source: the
    object as the caller gave it.
    """

    job: str
    T_scene_object: Matrix  # type: ignore[assignment]
    T_object_scene: Matrix  # type: ignore[assignment]
    center_scene: Array | None = None  # type: ignore[assignment]
    covariance: Array | None = None  # type: ignore[assignment]
    alternatives: list[Alternative] = []  # type: ignore[assignment]
    candidates: list[Candidate] | None = None  # type: ignore[assignment]
    artifacts: list[Artifact] = []  # type: ignore[assignment]
    source: str | None = None
    document: dict[str, Any] = MemberField(default={}, exclude=True)
    """The document of the service, plain (JSON) values."""

    @property
    def scale(self) -> float:
        """Object units per scene unit."""
        return float(np.cbrt(np.linalg.det(self.T_object_scene[:3, :3])))

    def apply(self, points: ArrayLike) -> Floats:
        """Transform points (N, 3) of the scene into the object's frame."""
        moved: Floats = (
            np.asarray(points, dtype=np.float64) @ self.T_object_scene[:3, :3].T + self.T_object_scene[:3, 3]
        )
        return moved

    def __repr__(self) -> str:
        sure = sure_in_words(self.probability, self.level)
        return f"Result({self.verdict}, {self.verdict_reason}{sure}, scale {self.scale:.4g}, job {self.job})"


class Rendering(Document):
    """The result of a rendering. job: its id · field: SHA-256 of the edited scene's field, if the output `field` was
    requested."""

    job: str
    frames: int
    size: tuple[int, int]
    depth_unit: float
    field: str | None = None
    artifacts: list[Artifact] = []

    def __repr__(self) -> str:
        width, height = self.size
        return f"Rendering({self.frames} frames of {width} x {height}, {len(self.artifacts)} files, job {self.job})"


@dataclass(frozen=True)
class BatchOutcome:
    """The outcome of one pair of a batch: a result or an error. detection, object: their indices in the lists."""

    detection: int
    object: int
    result: Result | None
    error: RegnfError | None = None


# A job's server-sent events: lines become events.


class EventReader:
    """Parses the lines of an event stream. A blank line may complete an event. It knows the position at which a new
    connection continues."""

    def __init__(self) -> None:
        self.last_id: str | None = None
        self.ended = False
        """Whether this event is the end of the job."""
        self._lines: dict[str, str] = {}

    def headers(self) -> dict[str, str]:
        """Of the next connection."""
        return {"Accept": "text/event-stream"} | ({} if self.last_id is None else {"Last-Event-ID": self.last_id})

    def connected(self) -> None:
        """A new connection begins. An incomplete event of the previous one is dropped."""
        self._lines = {}

    def take(self, line: str) -> Event | None:
        """The event that this line completes, if any."""
        if line:
            name, _, value = line.partition(":")
            self._lines[name] = value.removeprefix(" ")
            return None
        lines, self._lines = self._lines, {}
        if "data" not in lines:
            return None
        event = Event(id=lines.get("id", ""), name=lines.get("event", "message"), data=json.loads(lines["data"]))
        self.last_id = event.id or self.last_id
        self.ended = event.data.get("status") in FINISHED
        return event
