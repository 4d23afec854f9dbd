"""One registration, or one search among several objects, here or at a service, with what the command line says of it.

The request is the same in both places: the members of POST /register but the fields, as plain values.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from regnf_cli.guard import loading
from regnf_cli.report import exit_code, reporting, show, tell
from regnf_core.detections import Bounds, Detection, require_in_scene
from regnf_core.detections.images import AnyDetection, image_detection_in_field, read_detection
from regnf_core.errors import InvalidDetectionError, InvalidInputError, NoSurfaceError, filled_folder, require_writable
from regnf_core.field_source import FieldSource
from regnf_core.options import RegistrationOptions, RobustOptions

if TYPE_CHECKING:
    from regnf_client import Client, Job
    from regnf_core.document import RegistrationResult
    from regnf_core.field_notes import FieldNotes
    from regnf_core.fields.observation import SdfField
    from regnf_core.geometry.box import OrientedBox
    from regnf_core.library import LibraryObject, ObjectModel
    from regnf_data.recordings.recording import Recording
    from regnf_fit.images.place import Place

Objects = FieldSource | list[FieldSource]
"""One object to register, or several to search among."""


@dataclass(frozen=True)
class SentRecording:
    """A recording that is sent to a service. description: what its files do not say of it."""

    path: Path
    description: dict[str, Any]


def answer(
    scene: FieldSource | Recording | SentRecording,
    objects: Objects,
    request: dict[str, Any],
    files: Files,
    client: Client | None,
    tag: str | None = None,
    cancel: bool = False,
    as_json: bool = False,
    top: int = 0,
) -> None:
    """Register or search, print the result, write the files, and leave with the verdict's exit code.

    client: None does the work here · tag, cancel: see
    ``_register_remotely`` · top: how many candidates are shown.
    """
    if client is not None:
        assert isinstance(scene, SentRecording | FieldSource)
        document = _register_remotely(client, scene, objects, request, tag, files.output, cancel)
    else:
        assert not isinstance(scene, SentRecording)
        document = register_here(scene, objects, request, files)
    show(document, as_json, top)
    files.tell()
    raise typer.Exit(exit_code(document))


# The files that a registration leaves: those of its folder, and its recording.


@dataclass(frozen=True)
class Files:
    """What a registration is to write. output: a folder · recording: a file."""

    output: Path | None = None
    recording: Path | None = None

    def check(self) -> None:
        """Raises PermissionError before the work, which would be lost if nothing may be written there."""
        for folder in (self.output, self.recording and self.recording.parent):
            if folder is not None:
                require_writable(folder)

    def write(
        self, result: RegistrationResult, box: OrientedBox, more: Callable[[Path], object] | None = None, **said: Any
    ) -> None:
        """Write what is wanted, each file whole or not at all; ``said`` goes on to ``write_artifacts``.

        more: writes into the folder too.
        """
        if self.output is not None:
            from regnf_core.viewing.artifacts import write_artifacts

            with filled_folder(self.output) as folder:
                write_artifacts(result, folder, **said)
                if more is not None:
                    more(folder)
        if self.recording is not None:
            from regnf_core.viewing.recording import write_recording

            write_recording(result, self.recording, box, said["object_name"])

    def tell(self) -> None:
        """Say where the files are, on stderr: the document on stdout may be JSON."""
        if self.output is not None:
            picture = ", overlay.png" if (self.output / "overlay.png").is_file() else ""
            tell(f"wrote {self.output}: result.json, preview.png{picture}, point clouds")
        if self.recording is not None:
            tell(f"wrote {self.recording}")


# In this process.


def register_here(
    scene: FieldSource | Recording, objects: Objects, request: dict[str, Any], files: Files
) -> dict[str, Any]:
    """The result document, once the files are written."""
    with loading():
        from regnf_core.document import ranking_document, result_document
        from regnf_core.geometry.sim3 import Sim3
        from regnf_core.library import register, search_library
        from regnf_core.loading import import_smallest_first, load_field
        from regnf_core.object_models import object_model

    options, seed = RegistrationOptions.from_dict(request["options"]), request["seed"]
    detection = read_detection(request["detection"])
    wanted = files != Files()
    said: dict[str, Any] = {}
    files.check()
    named = [scene, *(objects if isinstance(objects, list) else [objects])]
    with reporting("loading") as report:
        import_smallest_first([one for one in named if isinstance(one, FieldSource)])
        notes: dict[str, FieldNotes] = {}
        seen: SdfField | Recording
        if isinstance(scene, FieldSource):
            opened = load_field(scene)
            seen, name, notes["scene"] = opened.field, scene.named, opened.notes
        else:
            seen, name = scene, Path(scene.name)
        where = partial(place_of, seen, detection, options, name)
        if isinstance(objects, list):
            place = where()
            library, unusable = modeled(objects, options.robust, partial(report, "library"))
            found = search_library(place.field, place.box, library, place.options, seed, report, clouds=wanted)
            result, said["object_name"] = found.result, found.ranking[0].name
            said["candidates"] = ranking_document(found.ranking, unusable)
            obj = load_field(next(one for one in objects if str(one.named) == said["object_name"]))
        else:
            obj = load_field(objects)
            model = None if notes else object_model(objects, options.robust)
            place = where(obj.field, model)
            start, truth = request["initial_transform"], request["ground_truth"]
            initial = Sim3.from_matrix(start) if start else None
            said["truth"] = Sim3.from_matrix(truth["T_object_scene"]) if truth else None
            result = register(
                place.field, obj.field, place.box, place.options, seed, report, initial, model, clouds=wanted
            )
            said["object_name"] = str(objects.named)
        result = place.seen(result)
        report("exporting", 1.0)
    for note in place.notes:
        tell(f"note: {note}")
    said["fields"] = notes | {"object": obj.notes}
    files.write(result, place.box, partial(place.draw, result, obj.field), **said)
    document: dict[str, Any] = result_document(result, **said)
    return document


def place_of(
    scene: SdfField | Recording,
    detection: AnyDetection,
    options: RegistrationOptions,
    named: Path,
    obj: SdfField | None = None,
    model: ObjectModel | None = None,
) -> Place:
    """named: the scene's path · obj, model: of the only object; of a recording, the object's size tells its unit.

    Raises InvalidDetectionError, DatasetError.
    """
    from regnf_data.recordings.recording import Recording
    from regnf_fit.images.place import place_in

    if not isinstance(scene, Recording):
        if not isinstance(detection, Detection):
            raise image_detection_in_field(named)
        check_box(named, detection, _bounds_of(scene), None if obj is None else _bounds_of(obj))
    return place_in(scene, detection, None if model is None else model.bounds, options)


def check_box(scene: Path, box: Detection, bounds: Bounds | None, obj: Bounds | None = None) -> None:
    """Refuse a box outside the scene as soon as its bounds are known: a checkpoint has no header that tells them.

    Raises InvalidDetectionError naming the scene's file.
    """
    try:
        if bounds is not None:
            require_in_scene(box, bounds, obj)
    except InvalidDetectionError as error:
        raise InvalidDetectionError(f"{scene}: {error}", reason=error.reason, hint=error.hint) from error


def _bounds_of(field: SdfField) -> Bounds:
    lower, upper = field.bounds.tolist()
    return lower, upper


def _field_of(source: FieldSource) -> SdfField:
    from regnf_core.loading import load_field

    return load_field(source).field


def modeled(
    objects: list[FieldSource], options: RobustOptions, progress: Callable[[float], None]
) -> tuple[list[LibraryObject], dict[str, str]]:
    """The objects with their models, and of those that are none the reasons, by name. Raises NoSurfaceError: all."""
    from regnf_core.library import LibraryObject
    from regnf_core.object_models import object_model

    library, unusable = [], {}
    for taken, one in enumerate(objects):
        progress(taken / len(objects))
        try:
            model = object_model(one, options)
        except NoSurfaceError as error:
            unusable[str(one.named)] = error.reason
        else:
            library.append(LibraryObject(str(one.named), partial(_field_of, one), model))
    if not library:
        raise NoSurfaceError("none of the files is usable as an object", reason="NO_SURFACE_IN_OBJECT")
    return library, unusable


# At a service, from the upload to the files.


def _register_remotely(
    client: Client,
    scene: FieldSource | SentRecording,
    objects: Objects,
    request: dict[str, Any],
    tag: str | None,
    output: Path | None,
    cancel: bool,
) -> dict[str, Any]:
    """The result document of a registration, or of a search among several objects, which it then names.

    objects: an empty list searches among the entries of the caller's library that have the ``tag`` · output: where to
    write the job's files · cancel: whether Ctrl+C cancels the job too.
    Raises ServiceError, UnreachableError, NoWorkerError; KeyboardInterrupt once the user has been told of the job.
    """
    with client, reporting("uploading") as report:
        searched: Any = objects or [one for one in client.library.entries(tag) if one.state != "rejected"]
        if not searched:
            which = "" if tag is None else f" with the tag {tag!r}"
            hint = "`regnf library add NAME FIELD --server ...` adds an entry."
            raise InvalidInputError(f"the library has no entries{which}", reason="LIBRARY_EMPTY", hint=hint)
        more = {name: value for name, value in request.items() if name != "detection"}
        place: Any = scene
        if isinstance(scene, SentRecording):
            place = client.recordings.upload(scene.path, progress=report, description=scene.description)
        job = client.submit(place, searched, request["detection"], more=more, progress=report)
        page = f"{client.address}/jobs/{job.id}/view"
        tell(f"job          {job.id}\npage         {page}")
        try:
            client.wait(job, report)
        except KeyboardInterrupt:
            _leave(client, job, page, cancel)
            raise
        found = client.result(job)
        if output is not None:
            with filled_folder(output) as folder:
                client.save(found, folder, report)
    document = found.document
    if found.candidates is not None:
        for place in (document, *document["candidates"]):
            place["object"] = job.sources.get(place["object"], place["object"])
    return document


def _leave(client: Client, job: Job, page: str, cancel: bool) -> None:
    """Say what becomes of the job after Ctrl+C."""
    if cancel:
        client.cancel(job)
        said = f"canceled the job {job.id}"
    else:
        said = (
            f"the job {job.id} continues. Run the same command to follow it again, or see {page}\n"
            f"To cancel it: curl -X POST {client.address}/jobs/{job.id}/cancel, "
            "or give --cancel-on-interrupt next time."
        )
    tell(said)
