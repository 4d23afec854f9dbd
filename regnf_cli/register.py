"""``regnf register``: one registration; ``regnf search``: which object of a library a detection shows.

Each is done here or on a server.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import regnf_cli.options as cli
from regnf_cli.guard import require
from regnf_cli.registration import Files, SentRecording, answer, check_box
from regnf_cli.report import tell
from regnf_core.detections import Detection
from regnf_core.detections.images import AnyDetection, image_detection_in_field, plain_values
from regnf_core.errors import InvalidInputError, InvalidOptionsError
from regnf_core.field_files import library_files, stored_bounds
from regnf_core.field_source import FieldSource, SettingsChoice
from regnf_core.library_folder import LibraryFolder
from regnf_core.options import Preset, RegistrationOptions
from regnf_core.processes import keep_freed_memory

if TYPE_CHECKING:
    from regnf_data.recordings.recording import Recording

LibraryObject = Annotated[
    Path,
    typer.Argument(
        help="The object: a field (a file, the folder of a training run, or an archive).",
        **cli.FIELD | {"metavar": "OBJECT"},
    ),
]


def register(
    scene: cli.Scene,
    object_: LibraryObject,
    detection: cli.DetectionFile,
    detection_index: cli.DetectionIndex = None,
    preset: Annotated[
        Preset | None,
        typer.Option(help="The method. robust needs no initial guess; paper is the published method. Default: robust."),
    ] = None,
    options: Annotated[
        Path | None, typer.Option(help="JSON file with registration options (see `regnf manual api`).", **cli.FILE)
    ] = None,
    scene_config: cli.SceneConfig = None,
    object_config: Annotated[
        Path | None,
        typer.Option(help="The trainer's config file of the object, or an archive with several.", **cli.FILE),
    ] = None,
    no_config: cli.NoConfigs = False,
    scene_description: cli.SceneDescription = None,
    object_description: Annotated[
        dict[str, Any] | None,
        typer.Option(help="Import options that are not in the object's file: a JSON file, or JSON.", **cli.DESCRIPTION),
    ] = None,
    node: cli.Node = None,
    initial_transform: Annotated[
        Path | None,
        typer.Option(
            help="Initial guess: a JSON file with a 4x4 T_object_scene, or a result.json. It is searched first.",
            **cli.FILE,
        ),
    ] = None,
    ground_truth: Annotated[
        Path | None,
        typer.Option(
            help="JSON file with the true T_object_scene. The errors of the result are then printed.", **cli.FILE
        ),
    ] = None,
    object_unit: cli.ObjectUnit = None,
    scale: cli.Scale = "known",
    depth_unit: cli.DepthUnit = None,
    intrinsics: cli.Intrinsics = None,
    layout: cli.Layout = None,
    camera_axes: cli.CameraAxes = None,
    seed: cli.Seed = 0,
    output: cli.Output = None,
    recording: cli.Recording = None,
    server: cli.Server = None,
    worker_timeout: cli.WorkerTimeout = 60,
    cancel_on_interrupt: cli.CancelOnInterrupt = False,
    token: cli.Token = None,
    as_json: cli.AsJson = False,
) -> None:
    """Find the pose of a known object in a scanned scene: rotation, position and scale.

    Example: **regnf register room.ckpt chair.ckpt --detection box.json --output out/**

    Exit codes: 0 registered, 4 ambiguous, 1 rejected, 2 bad input, 3 service unavailable.
    """
    keep_freed_memory()
    found = cli.read_detection(detection, detection_index)
    request = _request(found, cli.read_options(options, preset, object_unit, scale), seed)
    if initial_transform and RegistrationOptions.from_dict(request["options"]).preset != "robust":
        raise InvalidInputError(
            "only the preset robust can use an initial transform",
            reason="PRESET_UNSUITABLE",
            hint="Leave --initial-transform out, or use --preset robust.",
        )
    if initial_transform:
        request["initial_transform"] = cli.read_transform(initial_transform, "initial transform")
    if ground_truth:
        request["ground_truth"] = {"T_object_scene": cli.read_transform(ground_truth, "ground truth")}
    if server is None:
        require("engine", *(["rerun"] if recording else []))
    elif recording is not None:
        hint = "Leave --server out, or use the web page of the job."
        raise InvalidOptionsError("--recording works only without --server", hint=hint)
    said = depth_unit, intrinsics, layout, camera_axes
    of_object = cli.with_node(object_description, node)
    thing = cli.source_of(object_, of_object, cli.choice_of(object_config, no_config), "object")
    place = _place(
        scene, found, scene_description, cli.choice_of(scene_config, no_config), thing, said, server is not None
    )
    client = cli.client_of(server, token, worker_timeout)
    answer(place, thing, request, Files(output, recording), client, None, cancel_on_interrupt, as_json)


def _request(detection: AnyDetection, options: dict[str, Any], seed: int) -> dict[str, Any]:
    asked = {"detection": plain_values(detection), "options": options, "seed": seed}
    return asked | {"initial_transform": None, "ground_truth": None}


def _place(
    scene: Path,
    detection: AnyDetection,
    description: dict[str, Any] | None,
    settings: SettingsChoice,
    thing: FieldSource | None,
    said: tuple[Any, ...],
    remote: bool,
) -> FieldSource | Recording | SentRecording:
    """The scene's field, or a recording; a box outside of it is refused.

    thing: the only object · said: of the recording, as ``cli.given_of`` takes it.
    """
    if any(said) or cli.is_recording(scene):
        if any(said):
            require("engine")
        given = cli.given_of(*said) if any(said) or not remote else None
        if remote:
            return SentRecording(scene, {} if given is None else given.described().non_default())
        from regnf_data.recordings.opening import open_recording

        return open_recording(scene, given)
    place = cli.source_of(scene, description, settings, "scene")
    if not isinstance(detection, Detection):
        raise image_detection_in_field(scene)
    if thing is not None and place.file.samefile(thing.file):
        tell(f"warning: scene and object are the same file, {scene}")
    bounds = None if thing is None else stored_bounds(thing.file)
    check_box(place.file, detection, stored_bounds(place.file), bounds)
    return place


# The objects of a search: entries of libraries by their names, and fields by their files.


def search(
    scene: cli.Scene,
    detection: cli.DetectionFile,
    library: Annotated[
        list[Path] | None,
        typer.Argument(
            help="The objects: libraries, folders of fields, or fields. Default: your library.",
            parser=cli.library_path,
            metavar="[LIBRARY]...",
        ),
    ] = None,
    tag: Annotated[str | None, typer.Option(help="Search only library entries with this tag.")] = None,
    detection_index: cli.DetectionIndex = None,
    top: Annotated[int, typer.Option(min=1, help="Number of most probable candidates to print.")] = 5,
    options: Annotated[
        Path | None, typer.Option(help="JSON file with options of the preset robust.", **cli.FILE)
    ] = None,
    scene_config: cli.SceneConfig = None,
    object_config: Annotated[
        Path | None,
        typer.Option(help="The trainer's config file of all objects, or an archive with several.", **cli.FILE),
    ] = None,
    no_config: cli.NoConfigs = False,
    scene_description: cli.SceneDescription = None,
    object_description: Annotated[
        dict[str, Any] | None,
        typer.Option(
            help="Import options that are not in the objects' files: a JSON file, or JSON.", **cli.DESCRIPTION
        ),
    ] = None,
    object_unit: cli.ObjectUnit = None,
    scale: cli.Scale = "known",
    depth_unit: cli.DepthUnit = None,
    intrinsics: cli.Intrinsics = None,
    layout: cli.Layout = None,
    camera_axes: cli.CameraAxes = None,
    seed: cli.Seed = 0,
    output: cli.Output = None,
    server: cli.Server = None,
    worker_timeout: cli.WorkerTimeout = 60,
    cancel_on_interrupt: cli.CancelOnInterrupt = False,
    token: cli.Token = None,
    as_json: cli.AsJson = False,
) -> None:
    """Find which object of a library is in the box, and its pose.

    Example: **regnf search room.ckpt chairs/ --detection box.json --top 3**, or of your library
    **regnf search room.ckpt --tag seat --detection box.json**

    Exit codes: 0 registered, 4 ambiguous, 1 rejected (no candidate fits), 2 bad input, 3 service unavailable.
    """
    found = cli.read_detection(detection, detection_index)
    request = _request(found, cli.read_options(options, None, object_unit, scale), seed)
    if RegistrationOptions.from_dict(request["options"]).preset != "robust":
        message = f"{options}: only the preset robust searches a library"
        hint = "Remove the preset from the options."
        raise InvalidInputError(message, reason="PRESET_UNSUITABLE", hint=hint)
    if server is None:
        require("engine")
    said = depth_unit, intrinsics, layout, camera_axes
    place = _place(
        scene, found, scene_description, cli.choice_of(scene_config, no_config), None, said, server is not None
    )
    objects: list[FieldSource] = []
    if server is None or library:
        for one in objects_of(library, tag):
            chosen = cli.choice_of(object_config, no_config)
            objects += [cli.source_of(one, object_description, chosen, "object") if isinstance(one, Path) else one]
    client = cli.client_of(server, token, worker_timeout)
    answer(place, objects, request, Files(output), client, tag, cancel_on_interrupt, as_json, top)


def objects_of(named: list[Path] | None, tag: str | None) -> Iterator[FieldSource | Path]:
    """The entries and the files that are meant; without any path, the user's own library.

    Raises InvalidInputError (LIBRARY_EMPTY, LIBRARY_TOO_LARGE).
    """
    paths = named or [LibraryFolder.usual().folder]
    libraries = [LibraryFolder(path) for path in paths if not named or LibraryFolder.is_one(path)]
    entries = [(library, one) for library in libraries for one in library.entries(tag)]
    if libraries and not entries:
        which = "" if tag is None else f" with the tag {tag!r}"
        hint = "`regnf library add NAME FIELD` adds an entry. Or give a folder of fields."
        raise InvalidInputError(f"{libraries[0].folder}: no entries{which}", reason="LIBRARY_EMPTY", hint=hint)
    yield from (FieldSource(Path(one.notes.name), library.file(one)) for library, one in entries)
    files = [path for path in paths if path not in [library.folder for library in libraries]]
    yield from library_files(files) if files else ()
