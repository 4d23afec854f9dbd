"""``regnf register``: one registration, here or on a server."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from regnf_cli.console import err, out, phase_progress
from regnf_cli.extras import require
from regnf_cli.field_options import CONFIG, DESCRIPTION, choice_of, source_of
from regnf_cli.output import prepare, write_into
from regnf_cli.paths import FIELD, JSON_FILE, OUTPUT
from regnf_cli.report import exit_code, show_result
from regnf_cli.request_files import read_detection, read_options, read_transform
from regnf_cli.scene_file import check_box_by_header, open_scene
from regnf_core.detections import Detection
from regnf_core.errors import InvalidInputError
from regnf_core.field_source import FieldSource
from regnf_core.options import Preset, RegistrationOptions


def register(
    scene: Annotated[
        Path,
        typer.Argument(help="The scene's field: a file, a run's folder or an archive.", **FIELD | {"metavar": "SCENE"}),
    ],
    object_: Annotated[
        Path, typer.Argument(help="The library object's field, in the same forms.", **FIELD | {"metavar": "OBJECT"})
    ],
    detection: Annotated[
        Path, typer.Option(help="JSON: the box in the scene's frame and units, in any common form.", **JSON_FILE)
    ],
    detection_index: Annotated[
        int | None, typer.Option(min=0, help="Which one, where the file holds a list of detections; 0 is the first.")
    ] = None,
    preset: Annotated[
        Preset | None, typer.Option(help="robust (the default) needs no initial guess; paper is the published method.")
    ] = None,
    options: Annotated[
        Path | None, typer.Option(help="JSON: options by stage; the defaults otherwise.", **JSON_FILE)
    ] = None,
    scene_config: Annotated[
        Path | None, typer.Option(help="The settings that the scene was trained with: a file or an archive.", **CONFIG)
    ] = None,
    object_config: Annotated[Path | None, typer.Option(help="The same of the object.", **CONFIG)] = None,
    no_config: Annotated[
        bool, typer.Option("--no-config", help="Leave settings that lie beside a checkpoint unread.")
    ] = False,
    scene_description: Annotated[
        dict[str, Any] | None, typer.Option(help="What the scene's file does not say: a file or JSON.", **DESCRIPTION)
    ] = None,
    object_description: Annotated[
        dict[str, Any] | None, typer.Option(help="The same of the object.", **DESCRIPTION)
    ] = None,
    initial_transform: Annotated[
        Path | None,
        typer.Option(help="JSON: a T_object_scene to try first, as a 4x4 or in a result document.", **JSON_FILE),
    ] = None,
    truth: Annotated[
        Path | None, typer.Option(help="JSON with the true T_object_scene: errors are shown.", **JSON_FILE)
    ] = None,
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
    """Find where a known object stands in a scanned scene: rotation, position and scale.

    Example: **regnf register room.ckpt chair.ckpt --detection box.json --output out/**

    Exit codes: 0 registered, 4 ambiguous, 1 rejected, 2 bad input, 3 service unavailable.
    """
    box = read_detection(detection, detection_index)
    request: dict[str, Any] = {
        "detection": box.canonical(),
        "options": read_options(options, preset),
        "seed": seed,
        "initial_transform": read_transform(initial_transform, "initial transform") if initial_transform else None,
        "ground_truth": {"T_object_scene": read_transform(truth, "ground truth")} if truth else None,
    }
    if request["initial_transform"] and RegistrationOptions.from_dict(request["options"]).preset != "robust":
        raise InvalidInputError(
            "only the preset robust starts from a given transform",
            reason="INITIAL_TRANSFORM_UNSUPPORTED",
            hint="Leave --initial-transform out, or use --preset robust.",
        )
    if server is None:
        require("engine")
    sources = (
        source_of(scene, scene_description, choice_of(scene_config, no_config), "scene"),
        source_of(object_, object_description, choice_of(object_config, no_config), "object"),
    )
    if sources[0].file.samefile(sources[1].file):
        err.print(f"warning: scene and object are the same file, {scene}", markup=False, soft_wrap=True)
    check_box_by_header(sources[0].file, box, sources[1].file)
    if server is not None:
        from regnf_cli.remote import RemoteService
        from regnf_cli.remote_exchange import Delivery, register_remotely

        service = RemoteService(server, token, worker_timeout)
        document = register_remotely(service, *sources, request, Delivery(output, cancel_on_interrupt))
    else:
        document = _register_here(*sources, box, request, output)
    if as_json:
        out.print_json(json.dumps(document))
    else:
        show_result(document)
    raise typer.Exit(exit_code(document))


def _register_here(
    scene: FieldSource, object_: FieldSource, detection: Detection, request: dict[str, Any], output: Path | None
) -> dict[str, Any]:
    from regnf_core.geometry.box import OrientedBox
    from regnf_core.geometry.sim3 import Sim3
    from regnf_core.loading import load_field
    from regnf_core.registration import WarmStart
    from regnf_core.registration import register as run
    from regnf_core.viewing import result_document

    options = RegistrationOptions.from_dict(request["options"])
    box = OrientedBox.from_detection(detection)
    start = Sim3.from_matrix(request["initial_transform"]) if request["initial_transform"] else None
    truth = Sim3.from_matrix(request["ground_truth"]["T_object_scene"]) if request["ground_truth"] else None
    prepare(output)
    with phase_progress() as bar:
        task = bar.add_task("loading", total=1.0)
        opened, obj = open_scene(scene, detection), load_field(object_)
        result = run(
            opened.field,
            obj.field,
            box,
            options,
            request["seed"],
            lambda phase, share: bar.update(task, description=phase, completed=share),
            WarmStart(T_object_scene=start),
            clouds=output is not None,
        )
        bar.update(task, description="exporting", completed=1.0)
    said: dict[str, Any] = {
        "truth": truth,
        "object_name": str(object_.named),
        "fields": {"scene": opened.notes, "object": obj.notes},
    }
    write_into(output, result, **said)
    document: dict[str, Any] = result_document(result, **said)
    return document
