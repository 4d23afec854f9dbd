"""``regnf render`` and ``regnf edit``: pictures of a field; of a scene with objects put into it or taken out of it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

import regnf_cli.options as cli
from regnf_cli.guard import require
from regnf_cli.report import progress, say
from regnf_core.detections.images import plain_values
from regnf_core.errors import InvalidInputError, InvalidOptionsError, filled_folder, require_writable
from regnf_core.field_source import FieldSource, find_source
from regnf_core.rendering.request import MOST_FRAMES, RenderRequest

Folder = Annotated[Path, typer.Option(help="Output folder for the pictures.", **cli.OUTPUT)]
Request = Annotated[
    Path | None,
    typer.Option(
        help="JSON file with a complete request (docs/editing.md). Options of the command line take precedence.",
        **cli.FILE,
    ),
]
Size = Annotated[str | None, typer.Option(help="Size of the pictures. Default: 480x360.", metavar="WIDTHxHEIGHT")]
ModeChoice = Annotated[
    Literal["surface", "volume"] | None,
    typer.Option(
        help="surface: the zero level. volume: as NeuS renders; it takes three to four times as long. Default: surface."
    ),
]
Frames = Annotated[int | None, typer.Option(min=1, max=MOST_FRAMES, help="Number of cameras on the orbit. Default: 8.")]
Elevation = Annotated[
    float | None, typer.Option(help="Elevation of the orbit above the horizon, degrees. Default: 25.")
]
Around = Annotated[
    Path | None,
    typer.Option(
        help="JSON file with the box at the center of the orbit. Default: the box of the first edit, or the scene.",
        **cli.FILE,
    ),
]
UpAxis = Annotated[str | None, typer.Option(help="Up axis of the scene: x, y, z, -x, -y or -z. Default: z.")]
Outputs = Annotated[
    str | None,
    typer.Option(
        help="Files to write: color, depth, normal, animation, strip, mesh, field. Default: color,depth,normal,strip.",
        metavar="LIST",
    ),
]
Antialias = Annotated[int | None, typer.Option(min=1, max=4, help="Number of rays along each side of a pixel.")]
Processes = Annotated[
    int | None, typer.Option(min=1, help="Number of processes that share the frames. Default: one per core.")
]
CutAway = Annotated[
    bool, typer.Option("--cut-away", help="Allow cameras inside solid matter: it is cut away in front of them.")
]
_FILES = ("object", "replacement")


def render(
    field: cli.Field,
    output: Folder = Path("pictures"),
    request: Request = None,
    size: Size = None,
    mode: ModeChoice = None,
    frames: Frames = None,
    elevation: Elevation = None,
    distance: Annotated[
        float | None, typer.Option(help="Distance of the orbit's cameras, scene units. Default: everything is in view.")
    ] = None,
    around: Around = None,
    up_axis: UpAxis = None,
    cameras: Annotated[
        Path | None,
        typer.Option(
            help="Use these cameras instead of an orbit: transforms.json, meta_data.json, or the folder of "
            "such a file.",
            parser=cli.existing,
            metavar="PATH",
        ),
    ] = None,
    every: Annotated[int, typer.Option(min=1, help="With --cameras: use every N-th camera.")] = 1,
    outputs: Outputs = None,
    antialias: Antialias = None,
    cut_away: CutAway = False,
    processes: Processes = None,
    description: cli.Description = None,
    config: cli.Config = None,
    no_config: cli.NoConfig = False,
) -> None:
    """Render a field: colors, depths and normals from an orbit or from the cameras of a file.

    Example: **regnf render room.safetensors --around box.json --frames 8 --output pictures/**
    """
    require("engine")
    from regnf_core.rendering.camera_poses import poses_of_file

    wide = None if size is None else size_of(size)
    poses = None if cameras is None else poses_of_file(cameras, wide, every)
    wanted = request_of(
        request, around=around, poses=poses, size=size, mode=mode, frames=frames, elevation_deg=elevation,
        distance=distance, up=up_axis, outputs=outputs, antialias=antialias, cut_away=cut_away,
    )  # fmt: skip
    render_here(cli.source_of(field, description, cli.choice_of(config, no_config)), wanted, output, processes)


def edit(
    scene: cli.Scene,
    edits: Annotated[
        Path,
        typer.Option(
            help="JSON file with a list of edits (docs/editing.md). Objects are paths of files, relative "
            "to the folder of this file. A T_object_scene is a 4x4, or the path of a result.json.",
            **cli.FILE,
        ),
    ],
    output: Folder = Path("edited"),
    request: Request = None,
    size: Size = None,
    mode: ModeChoice = None,
    frames: Frames = None,
    elevation: Elevation = None,
    around: Around = None,
    up_axis: UpAxis = None,
    outputs: Outputs = None,
    antialias: Antialias = None,
    cut_away: CutAway = False,
    processes: Processes = None,
    scene_config: cli.SceneConfig = None,
    scene_description: cli.SceneDescription = None,
    no_config: cli.NoConfigs = False,
) -> None:
    """Substitute, replace, remove and insert objects in a scene: pictures before and after, a mesh, a new field.

    Example: **regnf edit room.safetensors --edits edits.json --outputs color,strip,mesh,field --output edited/**
    """
    require("engine")
    wanted = request_of(
        request, _edits(edits), around, size=size, mode=mode, frames=frames, elevation_deg=elevation, up=up_axis,
        outputs=outputs, antialias=antialias, cut_away=cut_away,
    )  # fmt: skip
    place = cli.source_of(scene, scene_description, cli.choice_of(scene_config, no_config), "scene")
    render_here(place, wanted, output, processes)


def request_of(
    file: Path | None,
    edits: list[Any] | None = None,
    around: Path | None = None,
    poses: list[dict[str, Any]] | None = None,
    **said: Any,
) -> RenderRequest:
    """The request: what ``file`` says, and in its place what options say (None: nothing).

    said: by the options' names. Raises InvalidInputError naming the member.
    """
    said = {name: value for name, value in said.items() if value is not None and value is not False}
    values = cli.read_object(file, "request") if file is not None else {}
    values |= {name: value for name, value in {"edits": edits, "poses": poses}.items() if value is not None}
    orbit: dict[str, Any] = {name: said[name] for name in ("frames", "elevation_deg", "distance", "up") if name in said}
    if around is not None:
        orbit["detection"] = plain_values(cli.read_detection(around))
    options: dict[str, Any] = {name: said[name] for name in ("mode", "antialias", "up", "cut_away") if name in said}
    for name, part in {"orbit": orbit, "options": options}.items():
        if part:
            values[name] = {**(values.get(name) or {}), **part}
    if "size" in said:
        values["size"] = size_of(said["size"])
    if "outputs" in said:
        values["outputs"] = [word.strip() for word in said["outputs"].split(",")]
    return RenderRequest.from_dict(values)


def size_of(text: str) -> tuple[int, int]:
    """Width and height. Raises InvalidOptionsError."""
    words = text.lower().split("x")
    if len(words) != 2 or not all(word.isdecimal() and len(word) < 8 and int(word) > 0 for word in words):
        raise InvalidOptionsError(f"--size {text[:40]}: expected WIDTHxHEIGHT in pixels, like 640x480")
    return int(words[0]), int(words[1])


# A rendering done in this process, with a bar: what ``regnf render`` and ``regnf edit`` share.


def render_here(scene: FieldSource, request: RenderRequest, output: Path, processes: int | None) -> None:
    """Write the request's files into ``output``, each whole or not at all. An object's name is its file.

    processes: None: one a core.
    """
    from regnf_core.fields.observation import SdfField
    from regnf_core.loading import load_field
    from regnf_core.rendering.job import run_render

    require_writable(output)

    def open_object(name: str) -> SdfField:
        return load_field(find_source(Path(name))).field

    with progress() as bar, filled_folder(output) as folder:
        task = bar.add_task("loading", total=1.0)
        field = load_field(scene).field
        bar.update(task, description="rendering")

        def tell(share: float) -> None:
            bar.update(task, completed=share)

        report = run_render(field, request, open_object, folder, tell, processes=processes or os.cpu_count() or 1)
    for artifact in report.artifacts:
        say(str(output / artifact.name))


def _edits(file: Path) -> list[Any]:
    """The list in ``file``, with the names of files in it taken from its folder on, and transforms read."""
    values = cli.read_json(file, "edits")
    if not isinstance(values, list):
        raise InvalidInputError(f"edits {file}: expected a JSON list", reason="MALFORMED_JSON", hint="Write [...].")
    return [_edit(value, file.parent) if isinstance(value, dict) else value for value in values]


def _edit(value: dict[str, Any], folder: Path) -> dict[str, Any]:
    found = dict(value)
    for name in _FILES:
        if isinstance(found.get(name), str):
            found[name] = str(folder / found[name])
    transform = found.get("T_object_scene")
    if isinstance(transform, str):
        found["T_object_scene"] = cli.read_transform(folder / transform, "transform")
    return found
