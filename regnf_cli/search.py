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
from regnf_cli.report import exit_code, show_ranking, show_result
from regnf_cli.request_files import parse_detection, read_object, read_options
from regnf_core.errors import InvalidInputError, NoSurfaceError
from regnf_core.importing.containers.sniff import HEAD_BYTES, sniff_format
from regnf_core.options import RegistrationOptions

_FILE: dict[str, Any] = {"exists": True, "dir_okay": False}
_MOST = 512


def search(
    scene: Annotated[Path, typer.Argument(help="The scene's field: safe field, checkpoint or mesh.", **_FILE)],
    library: Annotated[list[Path], typer.Argument(help="Folders of fields, or fields: the objects.", exists=True)],
    detection: Annotated[Path, typer.Option(help="JSON: the box in the scene's frame.", **_FILE)],
    top: Annotated[int, typer.Option(min=1, help="How many of the likeliest to print.")] = 5,
    options: Annotated[Path | None, typer.Option(help="JSON: options of the preset robust.", **_FILE)] = None,
    seed: Annotated[int, typer.Option(min=0, max=2**32 - 1)] = 0,
    output: Annotated[
        Path | None, typer.Option(help="Folder for the result, point clouds and pictures.", file_okay=False)
    ] = None,
    server: Annotated[
        str | None, typer.Option(help="Address of a regnf service; without it the work is done here.")
    ] = None,
    worker_timeout: Annotated[
        int, typer.Option(min=0, help="With --server: give up once it has had no live worker for so many seconds.")
    ] = 60,
    token: Annotated[str | None, typer.Option(envvar="REGNF_API_TOKEN", help="The service's bearer token.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the whole result document.")] = False,
) -> None:
    """Find which object of a library stands in the box, and lay it onto the library's.

    Example: **regnf search room.ckpt chairs/ --detection box.json --top 3**

    Exit codes: 0 registered, 4 ambiguous, 1 rejected (none of them fits), 2 bad input, 3 service unavailable.
    """
    request: dict[str, Any] = {
        "detection": read_object(detection, "detection"),
        "options": read_options(options, None),
        "seed": seed,
    }
    if RegistrationOptions.from_dict(request["options"]).preset != "robust":
        raise InvalidInputError("only the preset robust searches a library", reason="LIBRARY_SEARCH_UNSUPPORTED")
    objects = library_files(library)
    if server is not None:
        from regnf_cli.remote import RemoteService, search_remotely

        document = search_remotely(RemoteService(server, token, worker_timeout), scene, objects, request, output)
    else:
        require("engine")
        document = _search_here(scene, objects, request, output)
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
        raise InvalidInputError(f"no fields in {', '.join(map(str, named))}", reason="LIBRARY_EMPTY")
    if len(files) > _MOST:
        raise InvalidInputError(f"{len(files)} objects; at most {_MOST} are searched", reason="LIBRARY_TOO_LARGE")
    return list(files.values())


def _looks_like_a_field(path: Path) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return sniff_format(file.read(HEAD_BYTES)) is not None


def _search_here(scene: Path, objects: list[Path], request: dict[str, Any], output: Path | None) -> dict[str, Any]:
    from regnf_cli.object_models import object_model
    from regnf_core.library import LibraryObject, search_library
    from regnf_core.loading import load_field
    from regnf_core.viewing import ranking_document, result_document

    options = RegistrationOptions.from_dict(request["options"])
    box = parse_detection(request["detection"])
    prepare(output)
    library, unusable = [], {}
    with phase_progress() as bar:
        task = bar.add_task("library", total=1.0)
        scene_field = load_field(scene)
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
