"""Options and arguments that several commands have, each declared once: the types of those commands' parameters.

The name of an option is its parameter's. Its default stands in the command's signature.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from regnf_cli.report import tell
from regnf_core.detections import images as detections
from regnf_core.detections.images import AnyDetection
from regnf_core.errors import (
    RECORDING_SUFFIX,
    DatasetError,
    FieldFormatError,
    InvalidDetectionError,
    InvalidInputError,
    InvalidOptionsError,
    new_file,
)
from regnf_core.field_files import require_field_file, require_file
from regnf_core.field_source import FieldSource, Role, SettingsChoice, find_source
from regnf_core.options import METERS, Preset, RegistrationOptions, Unit
from regnf_core.rotations import Rows, transform_rows
from regnf_core.texts import json_value

if TYPE_CHECKING:
    from regnf_client import Client
    from regnf_data.recordings.recording import Given

# Files named at the command line: a name that cannot be used is refused with the one that was meant.


def _parser(check: Callable[[Path], object], folders: bool = False) -> Callable[[str], Path]:
    """What makes a path of an argument, unless ``check`` refuses it. folders: any folder will do."""

    def parse(text: str) -> Path:
        path = Path(text)
        if not (folders and path.is_dir()):
            check(path)
        return path

    return parse


def _no_folder(path: Path) -> None:
    """Raises InvalidInputError (FILE_NOT_FOUND, FILE_IS_NO_FOLDER)."""
    require_file(path)
    hint = f"Give the folder that contains it: {path.parent}"
    raise InvalidInputError(f"{path}: a file, expected a folder", reason="FILE_IS_NO_FOLDER", hint=hint)


file = _parser(require_file)
folder = _parser(_no_folder, folders=True)
existing = _parser(require_file, folders=True)
field_path = _parser(lambda path: find_source(path, config=False))
"""Of a field: a file, a training run's folder or an archive."""
scene_path = _parser(lambda path: is_recording(path) or find_source(path, config=False), folders=True)
"""Of a field, or of a recording: depth images with their cameras."""
library_path = _parser(require_field_file, folders=True)
"""A folder of fields, or a field."""


def is_recording(path: Path) -> bool:
    """Whether a path is a recording's; never without the engine's extra, which reads them."""
    if path.suffix == ".safetensors":
        return False  # a field: what knows recordings need not be loaded
    try:
        from regnf_data.recordings.opening import is_recording as known
    except ModuleNotFoundError:
        return False
    return known(path)


def output_folder(text: str) -> Path:
    """The path of a folder to write into, which may not be there yet. Raises InvalidInputError (FILE_IS_NO_FOLDER)."""
    path = Path(text)
    for place in (path, *path.parents):
        if place.is_dir():
            break
        if place.exists():
            message = f"{place}: a file, expected a folder for the output"
            raise InvalidInputError(message, reason="FILE_IS_NO_FOLDER", hint="Give another folder.")
    return path


def check_output(output: Path, endings: Sequence[str], given: Iterable[Path | None] = ()) -> None:
    """Refuse, before the work, a file to write that cannot be written, or is one of those ``given`` to be read.

    endings: those that its name may have. Raises InvalidOptionsError.
    """
    if output.suffix.lower() not in endings:
        hint = (
            "The suffix of the name selects the format."
            if len(endings) > 1
            else f"Write for example {output.stem}{endings[0]}."
        )
        expected = f"one of {', '.join(endings)}" if len(endings) > 1 else endings[0]
        raise InvalidOptionsError(f"{output}: expected a name that ends in {expected}", hint=hint)
    if not output.parent.is_dir():
        raise InvalidOptionsError(f"{output.parent}: no such folder", hint=f"Make it: mkdir -p {output.parent}")
    if any(one is not None and one.exists() and output.exists() and output.samefile(one) for one in given):
        raise InvalidOptionsError(
            f"{output}: this is an input file, and it would be overwritten", hint="Give another file for the output."
        )


def recording_file(text: str) -> Path:
    """The path of a recording to write, whose folder may not be there yet.

    Raises InvalidOptionsError for a name of something else, InvalidInputError (FILE_IS_FOLDER, FILE_IS_NO_FOLDER).
    """
    path = Path(text)
    output_folder(str(path.parent))
    return new_file(path, RECORDING_SUFFIX)


FIELD: dict[str, Any] = {"parser": field_path, "metavar": "FIELD"}
FILE: dict[str, Any] = {"parser": file, "metavar": "FILE"}
OUTPUT: dict[str, Any] = {"parser": output_folder, "metavar": "FOLDER"}
RECORDING: dict[str, Any] = {"parser": recording_file, "metavar": "FILE"}
"""How options and arguments of these kinds are declared."""


# The files that describe a registration at the command line: detection, options, transforms.

_TRANSFORM = 'Write {"T_object_scene": [[4 numbers], [4], [4], [0, 0, 0, 1]]}: scene coordinates to object coordinates;'
_TRANSFORM += ' or {"T_scene_object": ...}: object coordinates to scene coordinates.'


def read_detection(path: Path, index: int | None = None) -> AnyDetection:
    """The detection in a file, in any form. Raises InvalidInputError (MALFORMED_JSON) and InvalidDetectionError."""
    try:
        return detections.read_detection(read_json(path, "detection"), index, path.parent)
    except InvalidDetectionError as error:
        message = f"{path}: {error}"
        raise InvalidDetectionError(message, reason=error.reason, hint=error.hint, place=error.place) from error


def read_object(path: Path, what: str) -> dict[str, Any]:
    """A JSON object from a file. Raises InvalidInputError (MALFORMED_JSON) naming what the file was to hold."""
    value = read_json(path, what)
    if isinstance(value, dict):
        return value
    hint = "Write a JSON object: {...}."
    raise InvalidInputError(f"{what} {path}: expected a JSON object", reason="MALFORMED_JSON", hint=hint)


def read_options(
    path: Path | None, preset: Preset | None, unit: Unit | None = None, scale: str = "known"
) -> dict[str, Any]:
    """Plain options: those of a file, or none, with the preset that was requested by name, and the object's unit.

    Raises InvalidOptionsError when the file names another preset, or holds what is no option.
    """
    values = read_object(path, "options") if path else {}
    named = values.get("preset", preset)
    if preset is not None and named != preset:
        raise InvalidOptionsError(
            f"options.preset: {path} has {named!r}, and --preset is {preset}: leave one of them out"
        )
    options = values | {"preset": named} if named is not None else values
    if unit is not None or scale == "free":
        robust = options.get("robust", {})
        options = options | {"robust": robust | {"object_unit": "free" if scale == "free" else unit}}
    try:
        RegistrationOptions.from_dict(options)
    except InvalidOptionsError as error:
        source = f"{path}: " if path else ""
        hint = error.hint or "docs/api.md lists every option with its range."
        raise InvalidOptionsError(f"{source}{error}", reason=error.reason, hint=hint) from error
    return options


def read_transform(path: Path, what: str) -> Rows:
    """The 4x4 T_object_scene in a file: rows, a transform object, or a document with a T_object_scene of either kind,
    or with its inverse, T_scene_object.

    Raises InvalidInputError (INVALID_TRANSFORM) when there is none, or it is no similarity.
    """
    return as_transform(read_json(path, what), f"{what} {path}")


def as_transform(value: Any, what: str) -> Rows:
    """The same of a value. Raises InvalidInputError (INVALID_TRANSFORM), which begins with ``what``."""
    try:
        return transform_rows(value)
    except ValueError as error:
        raise InvalidInputError(f"{what}: {error}", reason="INVALID_TRANSFORM", hint=_TRANSFORM) from error


def is_json(text: str) -> bool:
    """Whether a text that stands where a file may be named is the JSON itself."""
    return text.lstrip().lstrip("\ufeff")[:1] in ("{", "[")


def read_json(path: Path, what: str) -> Any:
    """The value in a JSON file. Raises InvalidInputError (MALFORMED_JSON) naming what the file was to hold, OSError."""
    return json_value(path.read_bytes(), f"{what} {path}: ")


# Fields named at the command line: the options that go with them, and what they stand for.


def description(text: str) -> dict[str, Any]:
    """A description: JSON written out, or the name of a file that holds it.

    Raises InvalidInputError (FILE_NOT_FOUND, FILE_IS_FOLDER, MALFORMED_JSON), FieldFormatError (INVALID_DESCRIPTION).
    """
    from regnf_core.importing.upload_description import UploadDescription

    values = json_value(text, "description: ") if is_json(text) else read_object(file(text), "description")
    try:
        UploadDescription.from_dict(values)
    except FieldFormatError as error:
        hint = "docs/import-gate.md lists all import options."
        raise FieldFormatError(str(error), reason=error.reason, hint=error.hint or hint) from error
    return values


def with_node(description: dict[str, Any] | None, node: str | None) -> dict[str, Any] | None:
    """The description with the node of --node; itself without one."""
    return description if node is None else {**(description or {}), "node": node}


def choice_of(config: Path | None, no_config: bool) -> SettingsChoice:
    """Which settings are meant by --config and --no-config."""
    return config if config is not None else not no_config


def source_of(
    path: Path, said: Mapping[str, Any] | None, settings: SettingsChoice = None, role: Role | None = None
) -> FieldSource:
    """What a path stands for; the settings that were found are said. Raises what ``find_source`` does."""
    try:
        source = find_source(path, said, settings, role)
    except FieldFormatError as error:
        if error.reason != "RUN_WITHOUT_CHECKPOINT" or role == "object" or not path.is_dir():
            raise
        raise FieldFormatError(f"{error}. {_no_recording(path)}", reason=error.reason, hint=error.hint) from error
    if source.file != path:
        tell(f"checkpoint: {source.file}")
    if source.settings:
        tell(f"settings: {', '.join(source.settings_names)}")
    return source


def _no_recording(path: Path) -> str:
    """Why a folder is no recording either, in words."""
    from regnf_data.recordings.opening import open_recording

    try:
        open_recording(path.resolve())
    except DatasetError as error:
        return str(error)
    return ""


DESCRIPTION: dict[str, Any] = {"parser": description, "metavar": "JSON"}
"""How options of these kinds are declared. A description is a file, or the JSON itself."""


# a field by itself

Field = Annotated[
    Path, typer.Argument(help="A file, the folder of a training run, or an archive of such a folder.", **FIELD)
]
FieldOrRecording = Annotated[
    Path,
    typer.Argument(
        help="A field, or a recording: a folder of depth images, a bag.", parser=scene_path, metavar="FIELD|RECORDING"
    ),
]
Description = Annotated[
    dict[str, Any] | None,
    typer.Option(help="Import options that are not in the file: a JSON file, or JSON.", **DESCRIPTION),
]
Node = Annotated[
    str | None,
    typer.Option(
        help="Of a scene file with several nodes: the node to read, by its name or a path of names "
        "(of the object, for register)."
    ),
]
Config = Annotated[
    Path | None,
    typer.Option(
        help="The trainer's config file of the field (for example config.yml), or an archive with several.", **FILE
    ),
]
NoConfig = Annotated[bool, typer.Option("--no-config", help="Ignore config files next to the checkpoint.")]

# a scene, what stands in it, and where

Scene = Annotated[
    Path,
    typer.Argument(
        help="The scene: a field (a file, the folder of a training run, or an archive), or a recording "
        "(depth images, a bag).",
        parser=scene_path,
        metavar="SCENE",
    ),
]
DetectionFile = Annotated[
    Path,
    typer.Option(
        help="JSON: a box in the scene's frame and units. For a recording also a mask, box or point in an image.",
        **FILE,
    ),
]
DetectionIndex = Annotated[
    int | None,
    typer.Option(min=0, help="Index of the detection, if the file has a list of detections; 0 is the first."),
]
SceneConfig = Annotated[
    Path | None,
    typer.Option(
        help="The trainer's config file of the scene (for example config.yml), or an archive with several.", **FILE
    ),
]
NoConfigs = Annotated[bool, typer.Option("--no-config", help="Ignore config files next to the checkpoints.")]
SceneDescription = Annotated[
    dict[str, Any] | None,
    typer.Option(help="Import options that are not in the scene's file: a JSON file, or JSON.", **DESCRIPTION),
]

ObjectUnit = Annotated[
    Unit | None,
    typer.Option(help="The unit of the object's file. With a scene in meters it determines the scale within 1 %."),
]
Scale = Annotated[
    Literal["known", "free"],
    typer.Option(
        help="known: use the object's unit if it is known. free: the scale is unknown, also if the unit is given."
    ),
]

# what a recording does not say, or says wrongly

CameraAxes = Annotated[
    Literal["opencv", "opengl"] | None,
    typer.Option(
        "--camera-axes",
        help="Camera convention: opencv (+z forward) or opengl (-z forward). Default: as in the file format.",
    ),
]
DepthUnit = Annotated[
    str | None,
    typer.Option(
        help="Unit of depth images: m, cm, mm, meters per step, or steps per meter. Default: the unit of the layout."
    ),
]
Intrinsics = Annotated[
    str | None,
    typer.Option(
        help="Intrinsics of the depth camera: a file, or fx,fy,cx,cy in pixels.", metavar="FILE|FX,FY,CX,CY[,W,H]"
    ),
]
Layout = Annotated[str | None, typer.Option(help="Layout of the recording, if the detected one is wrong: bop, tum ...")]


def given_of(
    depth_unit: str | None = None,
    intrinsics: str | None = None,
    layout: str | None = None,
    axes: Literal["opencv", "opengl"] | None = None,
) -> Given:
    """What these options say of a recording. Raises InvalidOptionsError, DatasetError (DATASET_INTRINSICS_INVALID)."""
    from regnf_data.recordings.camera import camera_of, read_camera_file
    from regnf_data.recordings.camera import depth_unit as step_of
    from regnf_data.recordings.recording import Given

    step = None
    if depth_unit is not None:
        step = {str(name): meters for name, meters in METERS.items()}.get(depth_unit) or step_of(_positive(depth_unit))
        if step is None:
            hint = "Give mm, m, meters per step such as 0.001 or 0.0002, or steps per meter such as 5000."
            raise InvalidOptionsError(f"--depth-unit {depth_unit}: not a unit of depth images", hint=hint)
    camera = None
    if intrinsics is not None and Path(intrinsics).is_file():
        found = read_camera_file(Path(intrinsics))
        camera, step = (found.camera, step or found.depth_unit) if found else (None, step)
    elif intrinsics is not None and len(numbers := [_positive(one) for one in intrinsics.split(",")]) in (4, 6):
        size = (int(numbers[5]), int(numbers[4])) if numbers[4:] else None
        fx, fy, cx, cy = numbers[:4]
        if all(numbers):
            camera = camera_of(fx, fy, cx, cy, size, whole_centers=True).check("--intrinsics")
    if intrinsics is not None and camera is None:
        hint = "Give fx,fy,cx,cy in pixels, a file of Open3D, RealSense or ROS, or a file with a 3x3 matrix."
        raise InvalidOptionsError(f"--intrinsics {intrinsics[:200]}: no intrinsics", hint=hint)
    return Given(camera, step, layout, axes)


def _positive(text: str) -> float:
    """The number in a text; 0 where there is none above 0, or no finite one."""
    try:
        number = float(text)
    except ValueError:
        return 0.0
    return number if 0.0 < number < math.inf else 0.0


# the work and its result

Seed = Annotated[int, typer.Option(min=0, max=2**32 - 1)]
Output = Annotated[Path | None, typer.Option(help="Output folder for the result, point clouds and pictures.", **OUTPUT)]
Recording = Annotated[
    Path | None,
    typer.Option(help="File (.rrd) to write for the rerun viewer. Needs the extra `rerun`.", **RECORDING),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the complete result as JSON.")]

# a service elsewhere


def client_of(server: str | None, token: str | None, worker_timeout: int = 60) -> Client | None:
    """The client of a service; None where the work is done here."""
    if server is None:
        return None
    from regnf_client import Client

    return Client(server, token, worker_timeout_s=worker_timeout)


Server = Annotated[
    str | None, typer.Option(help="Address of a regnf service that does the work. Default: this machine does it.")
]
WorkerTimeout = Annotated[int, typer.Option(min=0, help="With --server: longest time to wait for a worker, seconds.")]
CancelOnInterrupt = Annotated[
    bool,
    typer.Option(
        "--cancel-on-interrupt", help="With --server: Ctrl+C cancels the job. Without this option the job continues."
    ),
]
Token = Annotated[
    str | None,
    typer.Option(
        envvar="REGNF_API_TOKEN",
        help="The service's bearer token.",
        # `$(cat FILE)` keeps the mark and the carriage return of a file that Windows wrote
        parser=lambda text: text.strip("\ufeff \t\r\n"),
        metavar="TOKEN",
    ),
]
