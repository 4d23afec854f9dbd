"""``regnf search``: which object of a library a detection shows, here or on a server."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import regnf_cli.options as cli
from regnf_cli.guard import require
from regnf_cli.report import err, exit_code, reporting, show
from regnf_core.detections import Bounds, Detection, require_in_scene
from regnf_core.errors import (
    Candidate,
    InvalidDetectionError,
    InvalidInputError,
    NoSurfaceError,
    RegnfError,
    Said,
    filled_folder,
    require_writable,
)
from regnf_core.field_files import library_files, stored_bounds
from regnf_core.field_source import FieldSource, SettingsChoice
from regnf_core.library_folder import LibraryFolder
from regnf_core.options import RegistrationOptions, RobustOptions

if TYPE_CHECKING:
    from regnf_core.document import RegistrationResult
    from regnf_core.fields.observation import SdfField
    from regnf_core.geometry.box import OrientedBox
    from regnf_core.library import LibraryObject
    from regnf_core.loading import LoadedField


# The objects of a search: entries of libraries by their names, and fields by their files.


def objects_of(
    named: list[Path] | None, tag: str | None, description: Mapping[str, Any] | None, settings: SettingsChoice
) -> Iterator[FieldSource]:
    """What each path stands for; without any, the user's own library.

    Raises InvalidInputError (LIBRARY_EMPTY, LIBRARY_TOO_LARGE), and what ``find_source`` does.
    """
    paths = named or [LibraryFolder.usual().folder]
    libraries = [LibraryFolder(path) for path in paths if not named or LibraryFolder.is_one(path)]
    entries = [(library, one) for library in libraries for one in library.entries(tag)]
    if libraries and not entries:
        which = "" if tag is None else f" with the tag {tag!r}"
        hint = "`regnf library add NAME FIELD` adds one; or name a folder of fields."
        raise InvalidInputError(f"{libraries[0].folder}: no entries{which}", reason="LIBRARY_EMPTY", hint=hint)
    for library, one in entries:
        yield FieldSource(Path(one.notes.name), library.file(one))
    files = [path for path in paths if path not in [library.folder for library in libraries]]
    for path in library_files(files) if files else ():
        yield cli.source_of(path, description, settings, "object")


# The files that a registration leaves: those of its folder, and its recording.


@dataclass(frozen=True)
class Files:
    """What a registration here is to write. output: a folder · recording: a file."""

    output: Path | None = None
    recording: Path | None = None

    @property
    def wanted(self) -> bool:
        """Whether anything is."""
        return self.output is not None or self.recording is not None

    def check(self) -> None:
        """Raises PermissionError before the work, which would be lost if nothing may be written there."""
        for folder in (self.output, self.recording and self.recording.parent):
            if folder is not None:
                require_writable(folder)

    def write(self, result: RegistrationResult, box: OrientedBox, **said: Any) -> None:
        """Write what is wanted, each file whole or not at all; ``said`` goes on to ``write_artifacts``."""
        from regnf_core.viewing.recording import write_recording

        write_into(self.output, result, **said)
        if self.recording is not None:
            write_recording(result, self.recording, box, said["object_name"])


def tell_files(output: Path | None, recording: Path | None = None) -> None:
    """Say where the files are, on stderr: the document on stdout may be JSON."""
    if output is not None:
        err.print(f"wrote {output}: result.json, preview.png, point clouds", markup=False, soft_wrap=True)
    if recording is not None:
        err.print(f"wrote {recording}", markup=False, soft_wrap=True)


def write_into(output: Path | None, result: RegistrationResult, **said: Any) -> None:
    """Write every artifact, each whole or not at all; ``said`` goes on to ``write_artifacts``."""
    from regnf_core.viewing.artifacts import write_artifacts

    if output is None:
        return
    with filled_folder(output) as folder:
        write_artifacts(result, folder, **said)


# The scene's file: opened only once the box is known to lie in it, as far as the file's header tells.


def check_box_by_header(scene: Path, box: Detection, obj: Path | None = None) -> None:
    """Refuse a box outside the scene before anything is opened; a checkpoint has no header that tells its bounds.

    Raises InvalidDetectionError naming the scene's file.
    """
    bounds = stored_bounds(scene)
    if bounds is not None:
        _require_in(scene, box, bounds, None if obj is None else stored_bounds(obj))


def open_scene(source: FieldSource, box: Detection, obj: SdfField | None = None) -> LoadedField:
    """The scene's field, refused as above by the bounds that only the imports of scene and object told."""
    from regnf_core.loading import load_field

    loaded = load_field(source)
    _require_in(source.named, box, _bounds_of(loaded.field), None if obj is None else _bounds_of(obj))
    return loaded


def _bounds_of(field: SdfField) -> Bounds:
    lower, upper = field.bounds.tolist()
    return lower, upper


def _require_in(path: Path, box: Detection, scene: Bounds, obj: Bounds | None) -> None:
    try:
        require_in_scene(box, scene, obj)
    except InvalidDetectionError as error:
        raise InvalidDetectionError(f"{path}: {error}", reason=error.reason, hint=error.hint) from error


Library = Annotated[
    list[Path] | None,
    typer.Argument(
        help="Libraries, folders of fields, or fields: the objects. Without any, your library.",
        parser=cli.library_path,
        metavar="[LIBRARY]...",
    ),
]
Tag = Annotated[str | None, typer.Option(help="Of libraries, only the entries with this tag.")]
Top = Annotated[int, typer.Option(min=1, help="How many of the likeliest to print.")]
Options = Annotated[Path | None, typer.Option(help="JSON: options of the preset robust.", **cli.JSON_FILE)]
ObjectConfig = Annotated[Path | None, typer.Option(help="The same of every object.", **cli.CONFIG)]
ObjectDescription = Annotated[dict[str, Any] | None, typer.Option(help="The same of every object.", **cli.DESCRIPTION)]


def search(
    scene: cli.Scene,
    detection: cli.DetectionFile,
    library: Library = None,
    tag: Tag = None,
    detection_index: cli.DetectionIndex = None,
    top: Top = 5,
    options: Options = None,
    scene_config: cli.SceneConfig = None,
    object_config: ObjectConfig = None,
    no_config: cli.NoConfigs = False,
    scene_description: cli.SceneDescription = None,
    object_description: ObjectDescription = None,
    seed: cli.Seed = 0,
    output: cli.Output = None,
    server: cli.Server = None,
    worker_timeout: cli.WorkerTimeout = 60,
    cancel_on_interrupt: cli.CancelOnInterrupt = False,
    token: cli.Token = None,
    as_json: cli.AsJson = False,
) -> None:
    """Find which object of a library stands in the box, and where.

    Example: **regnf search room.ckpt chairs/ --detection box.json --top 3**, or of your library
    **regnf search room.ckpt --tag seat --detection box.json**

    Exit codes: 0 registered, 4 ambiguous, 1 rejected (none of them fits), 2 bad input, 3 service unavailable.
    """
    box = cli.read_detection(detection, detection_index)
    request = _request(box, options, seed)
    place = cli.source_of(scene, scene_description, cli.choice_of(scene_config, no_config), "scene")
    check_box_by_header(place.file, box)
    settings = cli.choice_of(object_config, no_config)
    objects = [] if server and not library else list(objects_of(library, tag, object_description, settings))
    if server is None:
        require("engine")
        document = _search_here(place, objects, box, request, output)
    else:
        from regnf_cli.remote import register_remotely
        from regnf_client import Client

        client = Client(server, token, worker_timeout_s=worker_timeout)
        searched = objects if library else None
        document = register_remotely(client, place, searched, request, tag, output, cancel_on_interrupt)
    show(document, as_json, top)
    tell_files(output)
    raise typer.Exit(exit_code(document))


def _request(box: Detection, options: Path | None, seed: int) -> dict[str, Any]:
    """What a service is asked, too."""
    request: dict[str, Any] = {"detection": box.canonical(), "options": cli.read_options(options, None), "seed": seed}
    if RegistrationOptions.from_dict(request["options"]).preset != "robust":
        message = f"{options}: only the preset robust searches a library"
        hint = "Leave the preset out of the options."
        raise InvalidInputError(message, reason="PRESET_UNSUITABLE", hint=hint)
    return request


def _field_of(source: FieldSource) -> SdfField:
    from regnf_core.loading import load_field

    return load_field(source).field


def _modeled(
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


def _search_here(
    scene: FieldSource, objects: list[FieldSource], detection: Detection, request: dict[str, Any], output: Path | None
) -> dict[str, Any]:
    from regnf_core.document import ranking_document, result_document
    from regnf_core.geometry.box import OrientedBox
    from regnf_core.library import search_library
    from regnf_core.loading import import_smallest_first, safe_field

    options = RegistrationOptions.from_dict(request["options"])
    box = OrientedBox.from_detection(detection)
    Files(output).check()
    with reporting("library") as report:
        import_smallest_first((scene, *objects))
        opened = open_scene(scene, detection)
        library, unusable = _modeled(objects, options.robust, partial(report, "library"))
        found = search_library(
            opened.field,
            box,
            library,
            options,
            request["seed"],
            report,
            clouds=output is not None,
        )
        report("exporting", 1.0)
    winner = next(one for one in objects if str(one.named) == found.ranking[0].name)
    said: dict[str, Any] = {
        "object_name": found.ranking[0].name,
        "fields": {"scene": opened.notes, "object": safe_field(winner).notes},
        "candidates": ranking_document(found.ranking, unusable),
    }
    write_into(output, found.result, **said)
    document: dict[str, Any] = result_document(found.result, **said)
    return document


# What a file may be, where nothing in it tells: each with what to add to the command, and pictures on demand.


def show_candidates(error: RegnfError) -> None:
    """Say on stderr what to add to the command for each function that a refused file may be, if that is why."""
    asked: Sequence[Candidate] = getattr(error, "candidates", ())
    said: Said = getattr(error, "said", None) or Said(None, {})
    option = "--description" if said.use is None else f"--{said.use}-description"
    for number, one in enumerate(asked, 1):
        whole = one.added_to(said.description)
        err.print(f"{number}  {one.name}", markup=False, soft_wrap=True)
        err.print(f"   {option} {shlex.quote(json.dumps(whole))}", markup=False, soft_wrap=True)


def keep_pictures(asked: Sequence[Candidate], folder: Path) -> None:
    """Write the candidates' pictures, 1.png and so on as they are numbered; the folder is made if need be."""
    pictures = {f"{number}.png": one.picture for number, one in enumerate(asked, 1) if one.picture is not None}
    with filled_folder(folder) as work:
        for name, picture in pictures.items():
            (work / name).write_bytes(picture)
    for name in pictures:
        err.print(f"wrote {folder / name}", markup=False, soft_wrap=True)
