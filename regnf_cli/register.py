"""``regnf register``: one registration, here or on a server."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

import regnf_cli.options as cli
from regnf_cli.guard import require
from regnf_cli.report import err, exit_code, reporting, show
from regnf_cli.search import Files, check_box_by_header, open_scene, tell_files
from regnf_core.detections import Detection
from regnf_core.errors import InvalidInputError, InvalidOptionsError
from regnf_core.field_source import FieldSource
from regnf_core.options import Preset, RegistrationOptions

LibraryObject = Annotated[
    Path, typer.Argument(help="The library object's field, in the same forms.", **cli.FIELD | {"metavar": "OBJECT"})
]
ObjectConfig = Annotated[Path | None, typer.Option(help="The same of the object.", **cli.CONFIG)]
ObjectDescription = Annotated[dict[str, Any] | None, typer.Option(help="The same of the object.", **cli.DESCRIPTION)]
PresetChoice = Annotated[
    Preset | None, typer.Option(help="robust (the default) needs no initial guess; paper is the published method.")
]
Options = Annotated[Path | None, typer.Option(help="JSON: options by stage; the defaults otherwise.", **cli.JSON_FILE)]
InitialTransform = Annotated[
    Path | None,
    typer.Option(help="JSON: a T_object_scene to try first, as a 4x4 or in a result document.", **cli.JSON_FILE),
]
GroundTruth = Annotated[
    Path | None, typer.Option(help="JSON with the true T_object_scene: errors are shown.", **cli.JSON_FILE)
]


def register(
    scene: cli.Scene,
    object_: LibraryObject,
    detection: cli.DetectionFile,
    detection_index: cli.DetectionIndex = None,
    preset: PresetChoice = None,
    options: Options = None,
    scene_config: cli.SceneConfig = None,
    object_config: ObjectConfig = None,
    no_config: cli.NoConfigs = False,
    scene_description: cli.SceneDescription = None,
    object_description: ObjectDescription = None,
    initial_transform: InitialTransform = None,
    ground_truth: GroundTruth = None,
    seed: cli.Seed = 0,
    output: cli.Output = None,
    recording: cli.Recording = None,
    server: cli.Server = None,
    worker_timeout: cli.WorkerTimeout = 60,
    cancel_on_interrupt: cli.CancelOnInterrupt = False,
    token: cli.Token = None,
    as_json: cli.AsJson = False,
) -> None:
    """Find where a known object stands in a scanned scene: rotation, position and scale.

    Example: **regnf register room.ckpt chair.ckpt --detection box.json --output out/**

    Exit codes: 0 registered, 4 ambiguous, 1 rejected, 2 bad input, 3 service unavailable.
    """
    box = cli.read_detection(detection, detection_index)
    request = _request(box, cli.read_options(options, preset), seed, initial_transform, ground_truth)
    if server is None:
        require("engine", *(["rerun"] if recording else []))
    elif recording is not None:
        hint = "Leave --server out, or look at the page of the job."
        raise InvalidOptionsError("--recording is for registrations that are done here", hint=hint)
    place = cli.source_of(scene, scene_description, cli.choice_of(scene_config, no_config), "scene")
    thing = cli.source_of(object_, object_description, cli.choice_of(object_config, no_config), "object")
    if place.file.samefile(thing.file):
        err.print(f"warning: scene and object are the same file, {scene}", markup=False, soft_wrap=True)
    check_box_by_header(place.file, box, thing.file)
    if server is None:
        document = _register_here(place, thing, box, request, Files(output, recording))
    else:
        from regnf_cli.remote import register_remotely
        from regnf_client import Client

        client = Client(server, token, worker_timeout_s=worker_timeout)
        document = register_remotely(client, place, thing, request, output=output, cancel=cancel_on_interrupt)
    show(document, as_json)
    tell_files(output, recording)
    raise typer.Exit(exit_code(document))


def _request(
    box: Detection, options: dict[str, Any], seed: int, initial_transform: Path | None, truth: Path | None
) -> dict[str, Any]:
    """What a service is asked, too."""
    request: dict[str, Any] = {
        "detection": box.canonical(),
        "options": options,
        "seed": seed,
        "initial_transform": cli.read_transform(initial_transform, "initial transform") if initial_transform else None,
        "ground_truth": {"T_object_scene": cli.read_transform(truth, "ground truth")} if truth else None,
    }
    if request["initial_transform"] and RegistrationOptions.from_dict(options).preset != "robust":
        raise InvalidInputError(
            "only the preset robust starts from a given transform",
            reason="PRESET_UNSUITABLE",
            hint="Leave --initial-transform out, or use --preset robust.",
        )
    return request


def _register_here(
    scene: FieldSource, object_: FieldSource, detection: Detection, request: dict[str, Any], files: Files
) -> dict[str, Any]:
    from regnf_core.document import result_document
    from regnf_core.geometry.box import OrientedBox
    from regnf_core.geometry.sim3 import Sim3
    from regnf_core.library import WarmStart
    from regnf_core.library import register as run
    from regnf_core.loading import import_smallest_first, load_field

    options = RegistrationOptions.from_dict(request["options"])
    box = OrientedBox.from_detection(detection)
    start = Sim3.from_matrix(request["initial_transform"]) if request["initial_transform"] else None
    truth = Sim3.from_matrix(request["ground_truth"]["T_object_scene"]) if request["ground_truth"] else None
    files.check()
    with reporting("loading") as report:
        import_smallest_first((scene, object_))
        obj = load_field(object_)
        opened = open_scene(scene, detection, obj.field)
        result = run(
            opened.field,
            obj.field,
            box,
            options,
            request["seed"],
            report,
            WarmStart(T_object_scene=start),
            clouds=files.wanted,
        )
        report("exporting", 1.0)
    said: dict[str, Any] = {
        "truth": truth,
        "object_name": str(object_.named),
        "fields": {"scene": opened.notes, "object": obj.notes},
    }
    files.write(result, box, **said)
    document: dict[str, Any] = result_document(result, **said)
    return document
