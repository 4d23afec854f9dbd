"""Registrations, searches, batches and renderings, from the paths that a user has to the results."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from regnf_client.fields import Asking, FieldLike, known_sha256, smallest_first, upload
from regnf_client.jobs import id_of, rendering, result, submit, wait
from regnf_client.models import BatchOutcome, Entry, Job, Rendering, Result
from regnf_client.steps import Flow
from regnf_core.detections.parsing import BoxLike, detection_of
from regnf_core.errors import InvalidInputError, RegnfError
from regnf_core.options import OptionsLike, options_of
from regnf_core.pairs import pairs_of

_AT_ONCE = 16
"""Jobs of a batch that wait or run, so that a quota of active jobs holds them."""


@dataclass(frozen=True)
class Request:
    """What a registration asks for beside its fields. start: a T_object_scene to look at first, or
    ``{"T_scene_object": ...}``."""

    detection: BoxLike
    options: OptionsLike = None
    seed: int = 0
    start: Any = None
    more: Mapping[str, Any] = field(default_factory=dict)

    def body(self) -> dict[str, Any]:
        """As it is sent. Raises InvalidDetectionError and InvalidOptionsError before anything is sent."""
        options = None if self.options is None else options_of(self.options).to_dict()
        body = {
            "detection": detection_of(self.detection).canonical(),
            "options": options,
            "seed": self.seed,
            **self.more,
        }
        if self.start is not None:
            body["initial_transform"] = plain(self.start)
        return {name: value for name, value in body.items() if value is not None}


def submit_registration(asking: Asking, scene: FieldLike, obj: FieldLike, request: Request) -> Flow[Job]:
    """Upload what the service lacks, then ask for the registration."""
    body = request.body()
    sent: dict[str, str] = {}
    for role, one in smallest_first({"scene": scene, "object": obj}):
        sent[role] = (yield from upload(asking, one, role)).sha256
    return (yield from submit(asking, "/register", {**sent, **body}))


def register(asking: Asking, scene: FieldLike, obj: FieldLike, request: Request) -> Flow[Result]:
    """The same, and what it found."""
    job = yield from submit_registration(asking, scene, obj, request)
    yield from wait(asking, job)
    found = yield from result(asking, job)
    return found.model_copy(update={"source": _named(obj)})


def search(asking: Asking, scene: FieldLike, objects: Sequence[FieldLike], request: Request) -> Flow[Result]:
    """Which of the objects it is, and where."""
    body, several = request.body(), _several(objects)
    place = yield from upload(asking, scene, "scene")
    sources: dict[str, str] = {}
    for one in several:
        thing = yield from upload(asking, one, "object")
        sources.setdefault(thing.sha256, _named(one))
    job = yield from submit(asking, "/register", {"scene": place.sha256, "candidates": list(sources), **body})
    yield from wait(asking, job)
    found = yield from result(asking, job)
    ranking = [one.model_copy(update={"source": sources.get(one.object)}) for one in found.candidates or []]
    return found.model_copy(update={"source": sources.get(found.object or ""), "candidates": ranking})


@dataclass(frozen=True)
class Batch:
    """Pairs of detection and object, by their numbers; None: each with each."""

    detections: Sequence[BoxLike]
    objects: Sequence[FieldLike]
    pairs: Sequence[tuple[int, int]] | None
    options: OptionsLike
    seed: int


def batch(asking: Asking, scene: FieldLike, wanted: Batch) -> Flow[list[BatchOutcome]]:
    """An outcome for each pair, in their order. A pair that fails does not stop the others."""
    bodies = [Request(box, wanted.options, wanted.seed).body() for box in wanted.detections]
    objects = _several(wanted.objects)
    pairs = pairs_of(wanted.pairs, len(bodies), len(objects))
    place = yield from upload(asking, scene, "scene")
    things: dict[int, str | RegnfError] = {}
    for number in sorted({o for _, o in pairs}):
        try:
            things[number] = (yield from upload(asking, objects[number], "object")).sha256
        except RegnfError as error:
            things[number] = error
    jobs: list[Job | RegnfError] = []
    outcomes: list[BatchOutcome] = []
    for d, o in pairs:
        thing = things[o]
        if isinstance(thing, RegnfError):
            jobs.append(thing)
        else:
            jobs.append(
                (yield from _tried(submit(asking, "/register", {"scene": place.sha256, "object": thing, **bodies[d]})))
            )
        if len(jobs) - len(outcomes) >= _AT_ONCE:
            outcomes.append((yield from _outcome(asking, pairs[len(outcomes)], jobs[len(outcomes)])))
    while len(outcomes) < len(jobs):
        outcomes.append((yield from _outcome(asking, pairs[len(outcomes)], jobs[len(outcomes)])))
        asking.tell("registering", len(outcomes) / len(jobs))
    return outcomes


def _tried(flow: Flow[Job]) -> Flow[Job | RegnfError]:
    try:
        return (yield from flow)
    except RegnfError as error:
        return error


def _outcome(asking: Asking, pair: tuple[int, int], job: Job | RegnfError) -> Flow[BatchOutcome]:
    if isinstance(job, RegnfError):
        return BatchOutcome(*pair, None, job)
    try:
        yield from wait(asking, job)
        return BatchOutcome(*pair, (yield from result(asking, job)))
    except RegnfError as error:
        return BatchOutcome(*pair, None, error)


def submit_rendering(
    asking: Asking, scene: FieldLike, edits: Sequence[Mapping[str, Any]], request: Mapping[str, Any]
) -> Flow[Job]:
    """Upload what the service lacks, then ask for the rendering. Objects of edits may be paths, jobs may be results."""
    place = yield from upload(asking, scene, "scene")
    sent = []
    for edit in edits:
        known = plain(edit)
        for name in ("object", "replacement"):
            if name in edit:
                known[name] = (yield from upload(asking, edit[name], "object")).sha256
        if "job" in edit:
            known["job"] = id_of(edit["job"])
        sent.append(known)
    return (yield from submit(asking, "/render", {"scene": place.sha256, "edits": sent, **plain(request)}))


def render(
    asking: Asking, scene: FieldLike, edits: Sequence[Mapping[str, Any]], request: Mapping[str, Any]
) -> Flow[Rendering]:
    """The same, and what it made."""
    job = yield from submit_rendering(asking, scene, edits, request)
    yield from wait(asking, job)
    return (yield from rendering(asking, job))


def plain(value: Any) -> Any:
    """Arrays and tuples as lists, boxes as detections, transforms as their matrices: what JSON can hold."""
    if isinstance(value, Mapping):
        return {str(name): plain(part) for name, part in value.items()}
    if hasattr(value, "to_detection"):
        return value.to_detection().canonical()
    if callable(getattr(value, "matrix", None)):
        return plain(value.matrix())
    if hasattr(value, "tolist"):
        return value.tolist()
    return [plain(part) for part in value] if isinstance(value, list | tuple) else value


def _several(objects: Sequence[FieldLike]) -> list[FieldLike]:
    """A single path would be taken for a list of its letters."""
    if isinstance(objects, str) or not isinstance(objects, Sequence):
        hint = "Write a list: [object]."
        raise InvalidInputError("objects must be a list of fields", reason="INVALID_INPUT", hint=hint)
    if not objects:
        hint = "Give the objects to choose among."
        raise InvalidInputError("the list of objects is empty", reason="LIBRARY_EMPTY", hint=hint)
    return list(objects)


def _named(field: FieldLike) -> str:
    if isinstance(field, Entry):
        return field.name
    if not isinstance(field, str | os.PathLike) and not hasattr(field, "named"):
        return type(field).__name__
    return known_sha256(field) or str(getattr(field, "named", field))
