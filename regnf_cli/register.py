"""``regnf register``: one registration, here or on a server."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from regnf_cli.console import exit_code, out, phase_progress, read_json, show_result
from regnf_core.errors import InvalidDetectionError, InvalidInputError
from regnf_core.options import RegistrationOptions

if TYPE_CHECKING:
    from regnf_core.box import OrientedBox

_FILE: dict[str, Any] = {"exists": True, "dir_okay": False}


def register(
    scene: Annotated[Path, typer.Argument(help="The scene's field: safe field, checkpoint or mesh.", **_FILE)],
    object_: Annotated[Path, typer.Argument(metavar="OBJECT", help="The library object's field.", **_FILE)],
    detection: Annotated[Path, typer.Option(help="JSON: the box in the scene's frame.", **_FILE)],
    options: Annotated[
        Path | None, typer.Option(help="JSON: options by stage; the defaults otherwise.", **_FILE)
    ] = None,
    truth: Annotated[
        Path | None, typer.Option(help="JSON with the true T_object_scene: errors are shown.", **_FILE)
    ] = None,
    seed: Annotated[int, typer.Option(min=0, max=2**32 - 1)] = 0,
    output: Annotated[
        Path | None, typer.Option(help="Folder for the result, point clouds and pictures.", file_okay=False)
    ] = None,
    server: Annotated[
        str | None, typer.Option(help="Address of a regnf service; without it the work is done here.")
    ] = None,
    token: Annotated[str | None, typer.Option(envvar="REGNF_API_TOKEN", help="The service's bearer token.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the whole result document.")] = False,
) -> None:
    """Find the similarity transform that lays the scene's object onto the library's.

    Example: **regnf register room.ckpt chair.ckpt --detection box.json --output out/**
    """
    request = {
        "detection": read_json(detection, "detection"),
        "options": read_json(options, "options") if options else {},
        "seed": seed,
        "ground_truth": {"T_object_scene": _true_matrix(truth)} if truth else None,
    }
    if server is not None:
        from regnf_cli.remote import register_remotely

        document = register_remotely(server, token, scene, object_, request, output)
    else:
        document = _register_here(scene, object_, request, output)
    if as_json:
        out.print_json(json.dumps(document))
    else:
        show_result(document)
    raise typer.Exit(exit_code(document))


def parse_detection(values: dict[str, Any]) -> OrientedBox:
    """A detection's JSON as a box. Raises InvalidDetectionError for what is missing, unknown or malformed."""
    from regnf_core.box import OrientedBox

    known = {"min", "max", "centre", "size", "rotation_quaternion_xyzw", "label", "score"}
    if unknown := sorted(set(values) - known):
        raise InvalidDetectionError(f"detection holds unknown members: {', '.join(unknown)}")
    shared = {name: values[name] for name in ("label", "score") if values.get(name) is not None}
    try:
        if values.keys() & {"min", "max"}:
            if extra := sorted(values.keys() & {"centre", "size", "rotation_quaternion_xyzw"}):
                raise InvalidDetectionError(f"detection holds corners and {', '.join(extra)}: either, not both")
            return OrientedBox.from_corners(values["min"], values["max"], **shared)
        quaternion = values.get("rotation_quaternion_xyzw") or (0.0, 0.0, 0.0, 1.0)
        return OrientedBox.from_quaternion(values["centre"], values["size"], quaternion, **shared)
    except KeyError as error:
        raise InvalidDetectionError(f"detection lacks {error}") from error
    except (OverflowError, RuntimeError, TypeError, ValueError) as error:
        raise InvalidDetectionError("detection must hold lists of three numbers") from error


def _true_matrix(path: Path) -> Any:
    """The 4x4 of a ground-truth file, given plainly or as the transform object that results carry.

    Raises InvalidInputError (INVALID_TRANSFORM) when the file has neither.
    """
    transform = read_json(path, "ground truth").get("T_object_scene")
    matrix = transform.get("matrix") if isinstance(transform, dict) else transform
    if matrix is None:
        raise InvalidInputError(f"ground truth {path}: no T_object_scene with a matrix", reason="INVALID_TRANSFORM")
    return matrix


def _register_here(scene: Path, object_: Path, request: dict[str, Any], output: Path | None) -> dict[str, Any]:
    from regnf_core.diagnostics import result_document, write_artifacts
    from regnf_core.loading import load_field
    from regnf_core.registration import register as run
    from regnf_core.sim3 import Sim3

    options = RegistrationOptions.from_dict(request["options"])
    box = parse_detection(request["detection"])
    matrix = request["ground_truth"]["T_object_scene"] if request["ground_truth"] else None
    truth = Sim3.from_matrix(matrix) if matrix is not None else None
    if output is not None:
        output.mkdir(parents=True, exist_ok=True)  # before the work, which would be lost
    with phase_progress() as bar:
        task = bar.add_task("loading", total=1.0)
        fields = load_field(scene), load_field(object_)
        result = run(
            *fields,
            box,
            options,
            request["seed"],
            lambda phase, share: bar.update(task, description=phase, completed=share),
        )
        bar.update(task, description="exporting", completed=1.0)
    if output is not None:
        with tempfile.TemporaryDirectory(dir=output) as folder:
            for name in write_artifacts(result, Path(folder), truth=truth):
                (Path(folder) / name).replace(output / name)
    document: dict[str, Any] = result_document(result, truth=truth)
    return document
