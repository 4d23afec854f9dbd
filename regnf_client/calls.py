"""The methods of a client, each as a flow of steps. ``Client`` performs them, ``AsyncClient`` awaits them."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote
from uuid import uuid4

import regnf_client.fields as fields
import regnf_client.recordings as recordings
from regnf_client.answers import ServiceError, checked, parsed, refusal
from regnf_client.batches import BatchReader, Pair, plain, request_body
from regnf_client.fields import FieldLike, Sendable, known_sha256, smallest_first, source_of
from regnf_client.models import BatchOutcome, Entry, Field, Job, Rendering, Result
from regnf_client.recordings import detection_body
from regnf_client.steps import Asking, Connection, Download, Flow, Report, work
from regnf_core.detections.parsing import BoxLike
from regnf_core.errors import InvalidInputError
from regnf_core.field_source import Role, SettingsChoice
from regnf_core.library_entries import EntryNotes, checked_name
from regnf_core.library_folder import digest_of
from regnf_core.options import OptionsLike, options_of
from regnf_core.pairs import pairs_of

JobLike = str | Job | Result | Rendering
"""A job, its id, or its result."""
_PAGE = 200


class Calls:
    """Scenes and objects are paths (a file, a training run's folder, an archive of one), SHA-256s or ``Field`` objects.

    Errors: see :mod:`regnf_client.answers`.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def upload(
        self,
        field: Sendable,
        description: Mapping[str, Any] | None = None,
        settings: SettingsChoice = None,
        role: Role | None = None,
        progress: Report | None = None,
        timeout_s: float | None = None,
        wait: bool = True,
    ) -> Flow[Field]:
        """Upload a field and wait for its import (unless ``wait`` is False). ``description`` has import options that
        are in no file. ``settings`` is the trainer's config file (None: those next to the file, False: none), as in
        ``regnf.open_field``."""
        source = source_of(field, description, settings, role)
        return fields.upload(self._connection.asking(progress, timeout_s), source, wait=wait)

    def field(self, field: FieldLike) -> Flow[Field]:
        """The current state of a field. Raises ServiceError (FIELD_NOT_FOUND)."""
        return fields.find(self._connection.asking(), field)

    def fields(self, label: str | None = None) -> Flow[list[Field]]:
        """All fields, newest first."""
        found = yield from _pages(self._connection.asking(), "fields", {"label": label})
        return [parsed(Field, one) for one in found]

    def delete_field(self, field: FieldLike) -> Flow[None]:
        """Delete a field. Raises ServiceError (FIELD_IN_USE)."""
        asking = self._connection.asking()
        known = yield from fields.find(asking, field)
        yield from _done(asking, "DELETE", f"/fields/{known.sha256}")

    def register(
        self,
        scene: FieldLike,
        obj: FieldLike,
        detection: BoxLike,
        options: OptionsLike = None,
        seed: int = 0,
        initial_transform: Any = None,
        progress: Report | None = None,
        timeout_s: float | None = None,
    ) -> Flow[Result]:
        """Find the pose of an object in a scene. initial_transform: an initial guess, a T_object_scene (4, 4)."""
        body = request_body(detection, options, seed, initial_transform)
        return _registered(self._connection.asking(progress, timeout_s), scene, obj, body)

    def submit(
        self,
        scene: FieldLike,
        obj: FieldLike | list[FieldLike],
        detection: BoxLike,
        options: OptionsLike = None,
        seed: int = 0,
        initial_transform: Any = None,
        more: Mapping[str, Any] | None = None,
        progress: Report | None = None,
    ) -> Flow[Job]:
        """As ``register``, without waiting. If ``obj`` is a list, it is a search. more: members of the request that
        have no parameter here, such as ``webhook``."""
        body = request_body(detection, options, seed, initial_transform, more or {})
        return _submit(self._connection.asking(progress), scene, obj, body)

    def search(
        self,
        scene: FieldLike,
        objects: Sequence[FieldLike],
        detection: BoxLike,
        options: OptionsLike = None,
        seed: int = 0,
        progress: Report | None = None,
        timeout_s: float | None = None,
    ) -> Flow[Result]:
        """Find which of the objects is in the box, and its pose. ``candidates`` of the result ranks all objects."""
        body = request_body(detection, options, seed)
        return _registered(self._connection.asking(progress, timeout_s), scene, _several(objects), body)

    def register_batch(
        self,
        scene: FieldLike,
        detections: Sequence[BoxLike],
        objects: Sequence[FieldLike],
        pairs: Sequence[tuple[int, int]] | None = None,
        options: OptionsLike = None,
        seed: int = 0,
        progress: Report | None = None,
        timeout_s: float | None = None,
    ) -> Flow[list[BatchOutcome]]:
        """Several registrations in one scene. pairs: indices of detection and object; None: all combinations.

        A pair that fails does not stop the others.
        """
        boxes, several = [detection_body(box) for box in detections], _several(objects)
        chosen = None if options is None else options_of(options)
        wanted = pairs_of(pairs, len(boxes), len(several))
        asking = self._connection.asking(progress, timeout_s)
        place = yield from fields.upload(asking, scene, "scene")
        listed = [Pair(place, several[o], boxes[d], chosen, seed) for d, o in wanted]
        reader = BatchReader(asking, listed, asking.deadline())
        outcomes: dict[int, BatchOutcome] = {}
        while (found := (yield from reader.post())) is not None:
            while found is not None:
                for one in found:
                    whole = None
                    if one.error is None and one.job is not None:
                        whole = yield from _result(asking, one.job, _name_of(several[wanted[one.index][1]]))
                    outcomes[one.index] = BatchOutcome(*wanted[one.index], whole, one.error)
                found = yield from reader.read()
        return [outcome for _, outcome in sorted(outcomes.items())]

    def render(
        self,
        scene: FieldLike,
        edits: Sequence[Mapping[str, Any]] = (),
        request: Mapping[str, Any] | None = None,
        progress: Report | None = None,
        timeout_s: float | None = None,
    ) -> Flow[Rendering]:
        """Render a scene with edits: pictures, a mesh, a field. request: members of ``POST /render``.

        An object of an edit may be a path. A job of an edit may be a result.
        """
        asking = self._connection.asking(progress, timeout_s)
        place = yield from fields.upload(asking, scene, "scene")
        sent = []
        for edit in edits:
            known = plain(edit)
            for name in ("object", "replacement"):
                if name in edit:
                    known[name] = (yield from fields.upload(asking, edit[name], "object")).sha256
            if "job" in edit:
                known["job"] = id_of(edit["job"])
            sent.append(known)
        job = yield from _post(asking, "/render", {"scene": place.sha256, "edits": sent, **plain(request or {})})
        yield from _wait(asking, job)
        return (yield from self.rendering(job))

    def job(self, job: JobLike) -> Flow[Job]:
        """The current state of a job. Raises ServiceError (JOB_NOT_FOUND, JOB_EXPIRED)."""
        return self._connection.asking().document(Job, "GET", f"/jobs/{id_of(job)}")

    def jobs(self, status: str | None = None) -> Flow[list[Job]]:
        """All jobs, newest first."""
        found = yield from _pages(self._connection.asking(), "jobs", {"status": status})
        return [parsed(Job, one) for one in found]

    def wait(self, job: JobLike, progress: Report | None = None, timeout_s: float | None = None) -> Flow[Job]:
        """Wait until a job has finished. Raises WaitTimeoutError, NoWorkerError."""
        return _wait(self._connection.asking(progress, timeout_s), job)

    def cancel(self, job: JobLike) -> Flow[Job]:
        """Cancel a job. It is no error if the job was canceled already. Raises ServiceError (JOB_FINISHED)."""
        return self._connection.asking().document(Job, "POST", f"/jobs/{id_of(job)}/cancel")

    def result(self, job: JobLike) -> Flow[Result]:
        """The result of a registration. Raises ServiceError: JOB_NOT_READY, or the job's own reason if it failed."""
        return _result(self._connection.asking(), job)

    def rendering(self, job: JobLike) -> Flow[Rendering]:
        """The result of a rendering. Raises ServiceError like ``result``."""
        document = yield from _document(self._connection.asking(), job)
        return parsed(Rendering, {**document, "job": id_of(job)})

    def artifact(self, job: JobLike, name: str) -> Flow[bytes]:
        """The bytes of one file of a result. Raises ServiceError (ARTIFACT_NOT_FOUND)."""
        answer = yield from self._connection.asking().call("GET", _artifact_address(job, name))
        if not answer.is_success:
            raise refusal(answer)
        return answer.content

    def download(self, job: JobLike, name: str, target: str | Path) -> Flow[Path]:
        """Write one file of a result to ``target``. The target appears only when it is complete."""
        return _download(self._connection.asking(), _artifact_address(job, name), Path(target))

    def save(self, found: Result | Rendering, folder: str | Path, progress: Report | None = None) -> Flow[list[Path]]:
        """Write all files of a result into a folder. Raises ServiceError (DIGEST_MISMATCH)."""
        asking = self._connection.asking(progress)
        paths = []
        for number, one in enumerate(found.artifacts):
            asking.tell("downloading", number / len(found.artifacts))
            target = Path(folder) / Path(one.name).name  # never outside the folder
            paths.append((yield from _download(asking, _artifact_address(found, one.name), target, one.sha256)))
        asking.tell("downloading", 1.0)
        return paths


class RecordingCalls:
    """Recordings: depth images with their camera. A recording can be the scene of a registration. The detection can
    then be in its images: ``{"frame": ..., "mask" | "box_2d" | "point_2d": ...}``, or a list of these."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def upload(
        self,
        path: str | Path,
        label: str | None = None,
        progress: Report | None = None,
        timeout_s: float | None = None,
        wait: bool = True,
        description: Mapping[str, Any] | None = None,
    ) -> Flow[Field]:
        """Upload a folder, an archive of a folder, a bag or a stored recording, and wait for its import (unless
        ``wait`` is False). description: import options that are in no file: ``depth_unit``, ``layout``,
        ``camera_axes``, ``intrinsics``. Raises ServiceError with the import's reason."""
        asking = self._connection.asking(progress, timeout_s)
        return recordings.upload(asking, Path(path), label, description, wait)

    def frame(
        self,
        depth: recordings.Image,
        camera: Any,
        color: recordings.Image = None,
        depth_unit: float | None = None,
        T_world_camera: Any = None,
        after: Field | str | None = None,
        name: str | None = None,
        wait: bool = True,
    ) -> Flow[Field]:
        """One frame: paths, bytes or arrays (depth: (H, W), meters, or whole numbers of ``depth_unit`` meters; color:
        (H, W, 3) uint8). camera: a document of intrinsics, its path, or K. after: a recording to which this frame is
        added, with the name ``name``."""
        more = {"depth_unit": depth_unit, "T_world_camera": T_world_camera}
        form = recordings.frame_form(depth, camera, color, more)
        asking, address = self._connection.asking(), "/recordings"
        if after is not None:
            address, form["name"] = f"/recordings/{known_sha256(after)}/frames", (None, name or "")
        found = yield from asking.document(Field, "POST", address, files=form)
        return (yield from fields.ready(asking, found)) if wait else found

    def entries(self, label: str | None = None) -> Flow[list[Field]]:
        """All recordings, newest first."""
        found = yield from _pages(self._connection.asking(), "recordings", {"label": label})
        return [parsed(Field, one) for one in found]

    def picture(self, recording: Field | str, frame: str | int = 0) -> Flow[bytes]:
        """A PNG of a frame's color image, or of its depth. Raises ServiceError (RECORDING_FRAME_NOT_FOUND)."""
        address = f"/recordings/{known_sha256(recording)}/frames/{quote(str(frame), safe='')}/color.png"
        answer = yield from self._connection.asking().call("GET", address)
        if not answer.is_success:
            raise refusal(answer)
        return answer.content

    def delete(self, recording: Field | str) -> Flow[None]:
        """Delete a recording. Raises ServiceError (FIELD_IN_USE)."""
        return _done(self._connection.asking(), "DELETE", f"/recordings/{known_sha256(recording)}")


class LibraryCalls:
    """Objects by name. An ``Entry`` can be used in place of a field."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def add(
        self,
        name: str,
        field: FieldLike,
        tags: Sequence[str] = (),
        unit: str | None = None,
        note: str | None = None,
        symmetry: dict[str, Any] | None = None,
        progress: Report | None = None,
    ) -> Flow[Entry]:
        """Add a field to the library. A file is uploaded first. symmetry: order, axis, continuous; None: the detected
        one.

        Raises ServiceError (LIBRARY_NAME_TAKEN, FIELD_IN_LIBRARY), InvalidInputError (LIBRARY_ENTRY_INVALID).
        """
        notes = EntryNotes.checked(name, tags, unit, note, symmetry)
        asking = self._connection.asking(progress)
        sent = yield from fields.upload(asking, field, "object")
        return (yield from asking.document(Entry, "POST", "/library", json=notes.to_dict() | {"field": sent.sha256}))

    def entries(self, tag: str | None = None, name: str | None = None) -> Flow[list[Entry]]:
        """The entries with this tag, and with ``name`` in their names; newest first."""
        found = yield from _pages(self._connection.asking(), "library", {"tag": tag, "name": name})
        return [parsed(Entry, one) for one in found]

    def get(self, name: str) -> Flow[Entry]:
        """Raises ServiceError (LIBRARY_ENTRY_NOT_FOUND)."""
        return self._connection.asking().document(Entry, "GET", _entry_address(name))

    def change(self, name: str, /, **changes: Any) -> Flow[Entry]:
        """Change name, tags, unit, note or symmetry; None removes a value. Raises ServiceError (LIBRARY_NAME_TAKEN)."""
        return self._connection.asking().document(Entry, "PATCH", _entry_address(name), json=changes)

    def remove(self, name: str) -> Flow[None]:
        """Remove an entry; its field is kept. Raises ServiceError (LIBRARY_ENTRY_NOT_FOUND)."""
        return _done(self._connection.asking(), "DELETE", _entry_address(name))

    def download(self, name: str, target: str | Path) -> Flow[Path]:
        """Write an entry's field as a regnf field file. Raises ServiceError (LIBRARY_ENTRY_NOT_FOUND)."""
        return _download(self._connection.asking(), f"{_entry_address(name)}/file", Path(target))


def id_of(job: JobLike) -> str:
    """The id of a job. Raises InvalidInputError (INVALID_JOB)."""
    if isinstance(job, Job):
        return job.id
    name = job if isinstance(job, str) else getattr(job, "job", None)
    if isinstance(name, str) and name and all(part.isalnum() or part in "-_" for part in name):
        return name
    hint = "Give the return value of `submit`, or its `id`."
    raise InvalidInputError(f"{job!r} is no job", reason="INVALID_JOB", hint=hint)


def _registered(
    asking: Asking, scene: FieldLike, obj: FieldLike | list[FieldLike], body: dict[str, Any]
) -> Flow[Result]:
    job = yield from _submit(asking, scene, obj, body)
    yield from _wait(asking, job)
    return (yield from _result(asking, job))


def _submit(asking: Asking, scene: FieldLike, obj: FieldLike | list[FieldLike], body: dict[str, Any]) -> Flow[Job]:
    """Upload what the service lacks, then ask for the registration, or for the search among a list of objects."""
    sources: dict[str, str] = {}
    sent: dict[str, Any] = {}
    if isinstance(obj, list):
        sent["scene"] = (yield from fields.upload(asking, scene, "scene")).sha256
        for one, held in zip(obj, (yield from fields.upload_all(asking, obj, "object")), strict=True):
            sources.setdefault(held.sha256, _name_of(one))
        sent["candidates"] = list(sources)
    else:
        for role, field in smallest_first({"scene": scene, "object": obj}):
            sent[role] = (yield from fields.upload(asking, field, role)).sha256
        sources[sent["object"]] = _name_of(obj)
    job = yield from _post(asking, "/register", {**sent, **body})
    return job.model_copy(update={"sources": sources})


def _post(asking: Asking, address: str, body: Mapping[str, Any]) -> Flow[Job]:
    """The job of a request. One that is sent again, because an answer was lost, starts nothing again."""
    return asking.document(Job, "POST", address, json=body, headers={"Idempotency-Key": uuid4().hex})


def _wait(asking: Asking, job: JobLike) -> Flow[Job]:
    address, etag, deadline = f"/jobs/{id_of(job)}", None, asking.deadline()
    while True:
        # who wants no progress is not told of every change: one request lasts for many seconds
        headers: dict[str, str] = {} if etag is None or asking.report is None else {"If-None-Match": etag}
        params = {"wait": deadline.hold_s()}
        answer = yield from asking.call("GET", address, params=params, headers=headers)
        if answer.status_code != 304:
            found = parsed(Job, checked(answer))
            etag = answer.headers.get("etag")
            asking.tell(found.phase or found.status, found.progress)
            if found.finished:
                return found.model_copy(update={"sources": _sources(job)})
        deadline.check(f"the job {id_of(job)}")
        yield from asking.look()


def _document(asking: Asking, job: JobLike) -> Flow[dict[str, Any]]:
    return checked((yield from asking.call("GET", f"/jobs/{id_of(job)}/result")))


def _result(asking: Asking, job: JobLike, source: str | None = None) -> Flow[Result]:
    document, sources = (yield from _document(asking, job)), _sources(job)
    found = parsed(Result, {**document, "job": id_of(job), "document": document})
    if found.candidates is None:
        return found.model_copy(update={"source": next(iter(sources.values()), source)})
    ranking = [one.model_copy(update={"source": sources.get(one.object)}) for one in found.candidates]
    return found.model_copy(update={"source": sources.get(found.object or ""), "candidates": ranking})


def _sources(job: JobLike) -> dict[str, str]:
    return job.sources if isinstance(job, Job) else {}


def _done(asking: Asking, method: str, address: str) -> Flow[None]:
    answer = yield from asking.call(method, address)
    if not answer.is_success:
        raise refusal(answer)


def _pages(asking: Asking, what: str, chosen: dict[str, str | None]) -> Flow[list[dict[str, Any]]]:
    """Every entry of every page: a page may be short or empty and not be the last."""
    params: dict[str, Any] = {name: value for name, value in chosen.items() if value is not None} | {"limit": _PAGE}
    found: list[dict[str, Any]] = []
    while True:
        page = checked((yield from asking.call("GET", f"/{what}", params=params)))
        found += page[what if what in page else "entries"]
        if page["next_page_token"] is None:
            return found
        params = params | {"page_token": page["next_page_token"]}


def _download(asking: Asking, address: str, target: Path, sha256: str | None = None) -> Flow[Path]:
    """Raises ServiceError: ARTIFACT_NOT_FOUND, DIGEST_MISMATCH for bytes that are not those of ``sha256``."""
    target.parent.mkdir(parents=True, exist_ok=True)
    part = target.with_name(f"{target.name}.part")
    part.unlink(missing_ok=True)
    answer = yield from asking.again(Download(address, part))
    if not answer.is_success:
        raise refusal(answer)
    if sha256 is not None and (yield from work(partial(digest_of, part))) != sha256:
        part.unlink()
        hint = "Download it again; if that does not help, register again."
        message = f"{target.name}: the received bytes differ from the result's file"
        raise ServiceError(message, reason="DIGEST_MISMATCH", hint=hint)
    part.replace(target)
    return target


def _artifact_address(job: JobLike, name: str) -> str:
    return f"/jobs/{id_of(job)}/artifacts/{quote(name, safe='')}"


def _entry_address(name: str) -> str:
    """Raises InvalidInputError (LIBRARY_ENTRY_INVALID)."""
    return f"/library/{quote(checked_name(name), safe='')}"


def _several(objects: Sequence[FieldLike]) -> list[FieldLike]:
    """A single path would be taken for a list of its letters."""
    if isinstance(objects, str) or not isinstance(objects, Sequence):
        hint = "Write a list: [object]."
        raise InvalidInputError("objects must be a list of fields", reason="INVALID_INPUT", hint=hint)
    if not objects:
        hint = "Give the candidates."
        raise InvalidInputError("the list of objects is empty", reason="LIBRARY_EMPTY", hint=hint)
    return list(objects)


def _name_of(field: FieldLike) -> str:
    if isinstance(field, Entry):
        return field.name
    if not isinstance(field, str | os.PathLike) and not hasattr(field, "named"):
        return type(field).__name__
    return known_sha256(field) or str(getattr(field, "named", field))
