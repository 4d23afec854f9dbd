"""``regnf search``: which object of a library a detection shows, here or on a server."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from regnf_cli.console import phase_progress
from regnf_cli.extras import require
from regnf_cli.field_options import CONFIG, DESCRIPTION, choice_of, source_of
from regnf_cli.library_objects import objects_of
from regnf_cli.options import (
    AsJson,
    CancelOnInterrupt,
    DetectionFile,
    DetectionIndex,
    NoConfigs,
    Output,
    Scene,
    SceneConfig,
    SceneDescription,
    Seed,
    Server,
    Token,
    WorkerTimeout,
)
from regnf_cli.output import Files, tell_files, write_into
from regnf_cli.paths import JSON_FILE, library_path
from regnf_cli.report import exit_code, show
from regnf_cli.request_files import read_detection, read_options
from regnf_cli.scene_file import check_box_by_header, open_scene
from regnf_core.detections import Detection
from regnf_core.errors import InvalidInputError, NoSurfaceError
from regnf_core.field_source import FieldSource
from regnf_core.options import RegistrationOptions, RobustOptions

if TYPE_CHECKING:
    from regnf_core.fields.base import SdfField
    from regnf_core.library import LibraryObject

Library = Annotated[
    list[Path] | None,
    typer.Argument(
        help="Libraries, folders of fields, or fields: the objects. Without any, your library.",
        parser=library_path,
        metavar="[LIBRARY]...",
    ),
]
Tag = Annotated[str | None, typer.Option(help="Of libraries, only the entries with this tag.")]
Top = Annotated[int, typer.Option(min=1, help="How many of the likeliest to print.")]
Options = Annotated[Path | None, typer.Option(help="JSON: options of the preset robust.", **JSON_FILE)]
ObjectConfig = Annotated[Path | None, typer.Option(help="The same of every object.", **CONFIG)]
ObjectDescription = Annotated[dict[str, Any] | None, typer.Option(help="The same of every object.", **DESCRIPTION)]


def search(
    scene: Scene,
    detection: DetectionFile,
    library: Library = None,
    tag: Tag = None,
    detection_index: DetectionIndex = None,
    top: Top = 5,
    options: Options = None,
    scene_config: SceneConfig = None,
    object_config: ObjectConfig = None,
    no_config: NoConfigs = False,
    scene_description: SceneDescription = None,
    object_description: ObjectDescription = None,
    seed: Seed = 0,
    output: Output = None,
    server: Server = None,
    worker_timeout: WorkerTimeout = 60,
    cancel_on_interrupt: CancelOnInterrupt = False,
    token: Token = None,
    as_json: AsJson = False,
) -> None:
    """Find which object of a library stands in the box, and where.

    Example: **regnf search room.ckpt chairs/ --detection box.json --top 3**, or of your library
    **regnf search room.ckpt --tag seat --detection box.json**

    Exit codes: 0 registered, 4 ambiguous, 1 rejected (none of them fits), 2 bad input, 3 service unavailable.
    """
    box = read_detection(detection, detection_index)
    request = _request(box, options, seed)
    place = source_of(scene, scene_description, choice_of(scene_config, no_config), "scene")
    check_box_by_header(place.file, box)
    settings = choice_of(object_config, no_config)
    objects = [] if server and not library else list(objects_of(library, tag, object_description, settings))
    if server is None:
        require("engine")
        document = _search_here(place, objects, box, request, output)
    else:
        from regnf_cli.remote import RemoteService
        from regnf_cli.remote_exchange import Delivery, search_its_library, search_remotely

        service, delivery = RemoteService(server, token, worker_timeout), Delivery(output, cancel_on_interrupt)
        if library:
            document = search_remotely(service, place, objects, request, delivery)
        else:
            document = search_its_library(service, place, tag, request, delivery)
    show(document, as_json, top)
    tell_files(output)
    raise typer.Exit(exit_code(document))


def _request(box: Detection, options: Path | None, seed: int) -> dict[str, Any]:
    """What a service is asked, too."""
    request: dict[str, Any] = {"detection": box.canonical(), "options": read_options(options, None), "seed": seed}
    if RegistrationOptions.from_dict(request["options"]).preset != "robust":
        message = f"{options}: only the preset robust searches a library"
        hint = "Leave the preset out of the options."
        raise InvalidInputError(message, reason="LIBRARY_SEARCH_UNSUPPORTED", hint=hint)
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
    from regnf_core.geometry.box import OrientedBox
    from regnf_core.library import search_library
    from regnf_core.loading import import_smallest_first, safe_field
    from regnf_core.viewing import ranking_document, result_document

    options = RegistrationOptions.from_dict(request["options"])
    box = OrientedBox.from_detection(detection)
    Files(output).check()
    with phase_progress() as bar:
        task = bar.add_task("library", total=1.0)
        import_smallest_first((scene, *objects))
        opened = open_scene(scene, detection)
        library, unusable = _modeled(objects, options.robust, lambda share: bar.update(task, completed=share))
        found = search_library(
            opened.field,
            box,
            library,
            options,
            request["seed"],
            lambda phase, share: bar.update(task, description=phase, completed=share),
            clouds=output is not None,
        )
        bar.update(task, description="exporting", completed=1.0)
    winner = next(one for one in objects if str(one.named) == found.ranking[0].name)
    said: dict[str, Any] = {
        "object_name": found.ranking[0].name,
        "fields": {"scene": opened.notes, "object": safe_field(winner).notes},
        "candidates": ranking_document(found.ranking, unusable),
    }
    write_into(output, found.result, **said)
    document: dict[str, Any] = result_document(found.result, **said)
    return document
