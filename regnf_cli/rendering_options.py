"""Options that ``regnf render`` and ``regnf edit`` share, and the request that they become."""

from __future__ import annotations

import os
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from regnf_cli.options import JSON_FILE, OUTPUT, existing, read_detection, read_object
from regnf_cli.report import out, phase_progress
from regnf_core.errors import InvalidOptionsError, filled_folder, require_writable
from regnf_core.field_source import FieldSource, find_source
from regnf_core.rendering.request import MOST_FRAMES, RenderRequest


class Mode(StrEnum):
    """How rays see a field."""

    SURFACE = "surface"
    VOLUME = "volume"


Folder = Annotated[Path, typer.Option(help="The folder for the pictures.", **OUTPUT)]
Request = Annotated[
    Path | None,
    typer.Option(help="JSON: the whole request (docs/editing.md); other options take precedence.", **JSON_FILE),
]
Size = Annotated[str | None, typer.Option(help="Of every picture; 480x360 by default.", metavar="WIDTHxHEIGHT")]
ModeChoice = Annotated[
    Mode | None,
    typer.Option(
        help="surface: the zero level (the default). volume: as NeuS renders; takes three to four times as long."
    ),
]
Frames = Annotated[int | None, typer.Option(min=1, max=MOST_FRAMES, help="Cameras on the orbit; 8 by default.")]
Elevation = Annotated[float | None, typer.Option(help="Of the orbit above the horizon, degrees; 25 by default.")]
Distance = Annotated[float | None, typer.Option(help="Of the orbit's cameras, scene units; by default all is in view.")]
Around = Annotated[
    Path | None,
    typer.Option(help="JSON: a box to orbit round; by default the first edit's, or the scene.", **JSON_FILE),
]
Up = Annotated[str | None, typer.Option(help="The scene's vertical: x, y, z, -x, -y or -z; z by default.")]
CameraFile = Annotated[
    Path | None,
    typer.Option(
        help="Take these cameras in place of an orbit: transforms.json, meta_data.json or their folder.",
        parser=existing,
        metavar="PATH",
    ),
]
Every = Annotated[int, typer.Option(min=1, help="With --cameras: take one of so many.")]
Outputs = Annotated[
    str | None,
    typer.Option(
        help="Which files: color, depth, normal, animation, strip, mesh, field. color,depth,normal,strip by default.",
        metavar="LIST",
    ),
]
Antialias = Annotated[int | None, typer.Option(min=1, max=4, help="Rays along each side of a pixel.")]
Jobs = Annotated[
    int | None, typer.Option("--jobs", min=1, help="Processes that share the frames. By default one a core.")
]
CutAway = Annotated[
    bool, typer.Option("--cut-away", help="Cameras may stand in matter: what is before them is cut away.")
]


def request_of(
    file: Path | None,
    said: dict[str, Any],
    edits: list[Any] | None = None,
    around: Path | None = None,
    poses: list[dict[str, Any]] | None = None,
) -> RenderRequest:
    """The request: what ``file`` says, and in its place what options say (None: nothing).

    said: by the options' names. Raises InvalidInputError naming the member.
    """
    values = read_object(file, "request") if file is not None else {}
    if edits is not None:
        values["edits"] = edits
    if poses is not None:
        values["poses"] = poses
    orbit = {name: said[name] for name in ("frames", "elevation_deg", "distance", "up") if said.get(name) is not None}
    if around is not None:
        orbit["detection"] = read_detection(around).canonical()
    if orbit:
        values["orbit"] = {**(values.get("orbit") or {}), **orbit}
    options = {name: said[name] for name in ("mode", "antialias", "up") if said.get(name) is not None}
    if said.get("cut_away"):
        options["cut_away"] = True
    if options:
        values["options"] = {**(values.get("options") or {}), **options}
    if said.get("size") is not None:
        values["size"] = _size(said["size"])
    if said.get("outputs") is not None:
        values["outputs"] = [word.strip() for word in said["outputs"].split(",")]
    return RenderRequest.from_dict(values)


def poses_of(path: Path, every: int, size: tuple[int, int] | None) -> list[dict[str, Any]]:
    """The cameras of a file as a request says them."""
    from regnf_core.rendering.camera import cameras_of_file

    found = []
    for camera in cameras_of_file(path, size=size, every=every):
        rows = [[*axes, place] for axes, place in zip(camera.axes.tolist(), camera.position.tolist(), strict=True)]
        found.append(
            {
                "T_scene_camera": [*rows, [0.0, 0.0, 0.0, 1.0]],
                "intrinsics": [*camera.focal, *camera.middle],
                "size": [camera.width, camera.height],
            }
        )
    return found


def size_of(text: str | None) -> tuple[int, int] | None:
    """Width and height. Raises InvalidOptionsError."""
    if text is None:
        return None
    width, height = _size(text)
    return width, height


def _size(text: str) -> list[int]:
    words = text.lower().split("x")
    if len(words) != 2 or not all(word.isdecimal() and len(word) < 8 and int(word) > 0 for word in words):
        raise InvalidOptionsError(f"--size {text[:40]}: expected WIDTHxHEIGHT in pixels, like 640x480")
    return [int(word) for word in words]


# A rendering done in this process, with a bar: what ``regnf render`` and ``regnf edit`` share.


def render_here(scene: FieldSource, request: RenderRequest, output: Path, jobs: int | None) -> None:
    """Write the request's files into ``output``, each whole or not at all. An object's name is its file.

    jobs: processes; None: one a core.
    """
    from regnf_core.fields.observation import SdfField
    from regnf_core.loading import load_field
    from regnf_core.rendering.job import run_render

    require_writable(output)

    def open_object(name: str) -> SdfField:
        return load_field(find_source(Path(name))).field

    with phase_progress() as bar, filled_folder(output) as folder:
        task = bar.add_task("loading", total=1.0)
        field = load_field(scene).field
        bar.update(task, description="rendering")

        def tell(share: float) -> None:
            bar.update(task, completed=share)

        report = run_render(field, request, open_object, folder, tell, processes=jobs or os.cpu_count() or 1)
    for artifact in report.artifacts:
        out.print(str(output / artifact.name), markup=False, soft_wrap=True)
