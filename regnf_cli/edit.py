"""``regnf edit``: objects put into a scene or taken out of it, as pictures, a mesh and a field."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from regnf_cli.guard import require
from regnf_cli.options import (
    JSON_FILE,
    NoConfigs,
    Scene,
    SceneConfig,
    SceneDescription,
    choice_of,
    read_list,
    read_transform,
    source_of,
)
from regnf_cli.rendering_options import (
    Antialias,
    Around,
    CutAway,
    Elevation,
    Folder,
    Frames,
    Jobs,
    ModeChoice,
    Outputs,
    Request,
    Size,
    Up,
    render_here,
    request_of,
)

EditsFile = Annotated[
    Path,
    typer.Option(
        help="JSON: a list of edits (docs/editing.md). Objects are named by their files, from this file's folder on; a "
        "T_object_scene is a 4x4, or the name of a result.json that has one.",
        **JSON_FILE,
    ),
]
_FILES = ("object", "replacement")


def edit(
    scene: Scene,
    edits: EditsFile,
    output: Folder = Path("edited"),
    request: Request = None,
    size: Size = None,
    mode: ModeChoice = None,
    frames: Frames = None,
    elevation: Elevation = None,
    around: Around = None,
    up: Up = None,
    outputs: Outputs = None,
    antialias: Antialias = None,
    cut_away: CutAway = False,
    jobs: Jobs = None,
    scene_config: SceneConfig = None,
    scene_description: SceneDescription = None,
    no_config: NoConfigs = False,
) -> None:
    """Substitute, replace, remove and insert objects in a scene: pictures before and after, a mesh, a new field.

    Example: **regnf edit room.safetensors --edits edits.json --outputs color,strip,mesh,field --output edited/**
    """
    require("engine")
    said = {
        "size": size,
        "mode": None if mode is None else mode.value,
        "frames": frames,
        "elevation_deg": elevation,
        "up": up,
        "outputs": outputs,
        "antialias": antialias,
        "cut_away": cut_away,
    }
    wanted = request_of(request, said, _edits(edits), around)
    place = source_of(scene, scene_description, choice_of(scene_config, no_config), "scene")
    render_here(place, wanted, output, jobs)


def _edits(file: Path) -> list[Any]:
    """The list in ``file``, with the names of files in it taken from its folder on, and transforms read."""
    return [_edit(value, file.parent) if isinstance(value, dict) else value for value in read_list(file, "edits")]


def _edit(value: dict[str, Any], folder: Path) -> dict[str, Any]:
    found = dict(value)
    for name in _FILES:
        if isinstance(found.get(name), str):
            found[name] = str(folder / found[name])
    transform = found.get("T_object_scene")
    if isinstance(transform, str):
        found["T_object_scene"] = read_transform(folder / transform, "transform")
    return found
