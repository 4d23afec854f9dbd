"""``regnf inspect``: what a file holds, and whether it looks like a signed distance field; or what a recording is."""

from __future__ import annotations

import json
import shlex
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from regnf_cli.guard import require
from regnf_cli.options import (
    CameraAxes,
    Config,
    DepthUnit,
    Description,
    FieldOrRecording,
    Intrinsics,
    Layout,
    NoConfig,
    Node,
    choice_of,
    given_of,
    is_recording,
    source_of,
    with_node,
)
from regnf_cli.report import out, say, tell
from regnf_core.errors import FieldFormatError, InvalidInputError, InvalidOptionsError, atomic_path, filled_folder
from regnf_core.library_entries import shown_number

if TYPE_CHECKING:
    from regnf_data.recordings.recording import Given


def inspect(
    field: FieldOrRecording,
    description: Description = None,
    config: Config = None,
    no_config: NoConfig = False,
    node: Node = None,
    picture: Annotated[
        Path | None,
        typer.Option(
            help="A PNG to write: two views and a section. For a recording: images and a plan.", dir_okay=False
        ),
    ] = None,
    candidates: Annotated[
        Path | None,
        typer.Option(
            help="Folder for pictures of the possible readings, if the file is ambiguous.",
            file_okay=False,
            metavar="FOLDER",
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the report as JSON.")] = False,
    depth_unit: DepthUnit = None,
    intrinsics: Intrinsics = None,
    layout: Layout = None,
    axes: CameraAxes = None,
) -> None:
    """Show the report of a field file: its format and how it was recognized, bounds, parameters, plausibility. For a
    recording (depth images with cameras): layout, units, cameras, and whether its frames agree.

    Example: **regnf inspect step-000030000.ckpt --picture chair.png**

    If a file is ambiguous, the command prints the import option of each possible reading; `--candidates` draws them.
    """
    require("engine")
    if picture is not None and (picture.suffix.lower() != ".png" or not picture.parent.is_dir()):
        message = f"--picture {picture}: expected a name that ends in .png, in a folder that exists"
        raise InvalidOptionsError(message, hint="Write for example --picture field.png.")
    if candidates is not None and not candidates.parent.is_dir():
        message = f"--candidates {candidates}: {candidates.parent} is no folder that exists"
        raise InvalidOptionsError(message, hint=f"Make it: mkdir -p {candidates.parent}")
    said = given_of(depth_unit, intrinsics, layout, axes)
    if layout is not None or is_recording(field):
        more = {"--depth-unit": depth_unit, "--intrinsics": intrinsics, "--layout": layout, "--camera-axes": axes}
        named = [str(field), *(word for name, value in more.items() if value for word in (name, value))]
        _inspect_recording(field, said, picture, as_json, shlex.join(named))
        return
    from regnf_core.importing.gate.gate import import_field
    from regnf_core.importing.gate.picture import PICTURE_NAME

    description = with_node(description, node)
    source = source_of(field, description, choice_of(config, no_config))
    drawn = picture is not None or candidates is not None
    with tempfile.TemporaryDirectory() as folder:
        with _asked(candidates), source.naming(), source.packed_settings() as settings:
            report = import_field(source.file, Path(folder), description, None, drawn, settings).to_dict()
        if picture is not None:
            made = Path(folder) / PICTURE_NAME
            if not made.exists():
                raise InvalidInputError("no picture was made: the field is too slow to draw", reason="NO_PICTURE")
            shutil.copyfile(made, picture)
    if as_json:
        out.print_json(json.dumps(report))
    else:
        _show(report)


def _inspect_recording(path: Path, said: Given, picture: Path | None, as_json: bool, named: str) -> None:
    """named: the recording, as the commands that come next name it."""
    from regnf_data.recordings.opening import open_recording
    from regnf_fit.images.inspecting import inspect_recording

    recording = open_recording(path, said)
    found = inspect_recording(recording, said)
    if picture is not None:
        with atomic_path(picture) as temporary:
            found.picture.save(temporary, "PNG")
    if as_json:
        out.print_json(json.dumps({"name": recording.name, **found.report}))
        return
    _show({"name": recording.name, **found.report})
    out.print("next:")
    say(f"  regnf register {named} object.stl --detection detection.json --output out/")
    if len(recording) > 1 and "DISAGREE" not in found.report["agreement"]:
        say(f"  regnf fuse {named} map.safetensors")


@contextmanager
def _asked(folder: Path | None) -> Iterator[None]:
    """Pictures of what a refused file may be are kept in the folder, 1.png and so on as they are numbered."""
    try:
        yield
    except FieldFormatError as error:
        if folder is not None and error.candidates:
            with filled_folder(folder) as work:
                for number, one in enumerate(error.candidates, 1):
                    if one.picture is not None:
                        (work / f"{number}.png").write_bytes(one.picture)
                        tell(f"wrote {folder / f'{number}.png'}")
        raise


def _show(values: dict[str, Any], indent: int = 0) -> None:
    for name, value in values.items():
        if isinstance(value, dict):
            out.print(f"{'  ' * indent}{name}:")
            _show(value, indent + 1)
        else:
            for line in value if name == "assumed" and value else [value]:
                say(f"{'  ' * indent}{name:<24} {_readable(line)}")


def _readable(value: Any) -> str:
    if isinstance(value, float):
        return shown_number(value)
    if isinstance(value, list | tuple):
        parts = [_readable(part) for part in value]
        return f"[{', '.join(parts)}]" if any(isinstance(part, float) for part in value) else "; ".join(parts) or "none"
    return "-" if value is None else str(value)
