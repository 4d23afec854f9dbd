"""``regnf search``: which object of a library a detection shows, here or on a server."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from regnf_cli.console import out, phase_progress
from regnf_cli.extras import require
from regnf_cli.output import prepare, write_into
from regnf_cli.paths import FIELD, JSON_FILE, OUTPUT, library_path
from regnf_cli.report import exit_code, show_ranking, show_result
from regnf_cli.request_files import read_detection, read_options
from regnf_cli.scene_file import check_box_by_header, open_scene
from regnf_core.detections import Detection
from regnf_core.errors import InvalidInputError, NoSurfaceError
from regnf_core.importing.containers.sniff import HEAD_BYTES, sniff_format
from regnf_core.options import RegistrationOptions

_MOST = 512


def search(
    scene: Annotated[
        Path, typer.Argument(help="The scene's field: safe field, checkpoint or mesh.", **FIELD | {"metavar": "SCENE"})
    ],
    library: Annotated[
        list[Path],
        typer.Argument(help="Folders of fields, or fields: the objects.", parser=library_path, metavar="LIBRARY..."),
    ],
    detection: Annotated[
        Path, typer.Option(help="JSON: the box in the scene's frame and units, in any common form.", **JSON_FILE)
    ],
    detection_index: Annotated[
        int | None, typer.Option(min=0, help="Which one, where the file holds a list of detections; 0 is the first.")
    ] = None,
    top: Annotated[int, typer.Option(min=1, help="How many of the likeliest to print.")] = 5,
    options: Annotated[Path | None, typer.Option(help="JSON: options of the preset robust.", **JSON_FILE)] = None,
    seed: Annotated[int, typer.Option(min=0, max=2**32 - 1)] = 0,
    output: Annotated[
        Path | None, typer.Option(help="Folder for the result, point clouds and pictures.", **OUTPUT)
    ] = None,
    server: Annotated[
        str | None, typer.Option(help="Address of a regnf service; without it the work is done here.")
    ] = None,
    worker_timeout: Annotated[
        int, typer.Option(min=0, help="With --server: seconds to wait for a worker before giving up.")
    ] = 60,
    cancel_on_interrupt: Annotated[
        bool, typer.Option("--cancel-on-interrupt", help="With --server: Ctrl+C cancels the job; it goes on otherwise.")
    ] = False,
    token: Annotated[str | None, typer.Option(envvar="REGNF_API_TOKEN", help="The service's bearer token.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the whole result document.")] = False,
) -> None:
    """Find which object of a library stands in the box, and where.

    Example: **regnf search room.ckpt chairs/ --detection box.json --top 3**

    Exit codes: 0 registered, 4 ambiguous, 1 rejected (none of them fits), 2 bad input, 3 service unavailable.
    """
    box = read_detection(detection, detection_index)
    request: dict[str, Any] = {
        "detection": box.canonical(),
        "options": read_options(options, None),
        "seed": seed,
    }
    if RegistrationOptions.from_dict(request["options"]).preset != "robust":
        message = f"{options}: only the preset robust searches a library"
        hint = "Leave the preset out of the options."
        raise InvalidInputError(message, reason="LIBRARY_SEARCH_UNSUPPORTED", hint=hint)
    check_box_by_header(scene, box)
    objects = library_files(library)
    if server is not None:
        from regnf_cli.remote import RemoteService
        from regnf_cli.remote_exchange import Delivery, search_remotely

        service = RemoteService(server, token, worker_timeout)
        document = search_remotely(service, scene, objects, request, Delivery(output, cancel_on_interrupt))
    else:
        require("engine")
        document = _search_here(scene, objects, box, request, output)
    if as_json:
        out.print_json(json.dumps(document))
    else:
        show_ranking(document, top)
        show_result(document)
    raise typer.Exit(exit_code(document))


def library_files(named: list[Path]) -> list[Path]:
    """The files named, and those of the folders named that look like fields, each once, in order.

    Raises InvalidInputError (LIBRARY_EMPTY, LIBRARY_TOO_LARGE).
    """
    files: dict[Path, Path] = {}
    for path in named:
        for file in sorted(filter(_looks_like_a_field, path.iterdir())) if path.is_dir() else [path]:
            files.setdefault(file.resolve(), file)
    if not files:
        message = f"{', '.join(map(str, named))}: no fields in it, expected safe fields, checkpoints or meshes"
        hint = "Give the folder that holds the objects' files; folders inside it are not searched."
        raise InvalidInputError(message, reason="LIBRARY_EMPTY", hint=hint)
    if len(files) > _MOST:
        raise InvalidInputError(f"{len(files)} objects; at most {_MOST} are searched", reason="LIBRARY_TOO_LARGE")
    return list(files.values())


def _looks_like_a_field(path: Path) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return sniff_format(file.read(HEAD_BYTES)) is not None


def _search_here(
    scene: Path, objects: list[Path], detection: Detection, request: dict[str, Any], output: Path | None
) -> dict[str, Any]:
    from regnf_cli.object_models import object_model
    from regnf_core.geometry.box import OrientedBox
    from regnf_core.library import LibraryObject, search_library
    from regnf_core.loading import load_field
    from regnf_core.viewing import ranking_document, result_document

    options = RegistrationOptions.from_dict(request["options"])
    box = OrientedBox.from_detection(detection)
    prepare(output)
    library, unusable = [], {}
    with phase_progress() as bar:
        task = bar.add_task("library", total=1.0)
        scene_field = open_scene(scene, detection)
        for taken, path in enumerate(objects):
            bar.update(task, completed=taken / len(objects))
            try:
                library.append(LibraryObject(str(path), partial(load_field, path), object_model(path, options.robust)))
            except NoSurfaceError as error:
                unusable[str(path)] = error.reason
        if not library:
            raise NoSurfaceError("none of the files is usable as an object", reason="NO_SURFACE_IN_OBJECT")
        found = search_library(
            scene_field,
            box,
            library,
            options,
            request["seed"],
            lambda phase, share: bar.update(task, description=phase, completed=share),
        )
        bar.update(task, description="exporting", completed=1.0)
    said: dict[str, Any] = {
        "object_name": found.ranking[0].name,
        "candidates": ranking_document(found.ranking, unusable),
    }
    write_into(output, found.result, **said)
    document: dict[str, Any] = result_document(found.result, **said)
    return document
