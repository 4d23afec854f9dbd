"""``regnf render``: pictures of a field."""

from __future__ import annotations

from pathlib import Path

from regnf_cli.guard import require
from regnf_cli.options import Config, Description, Field, NoConfig, choice_of, source_of
from regnf_cli.rendering_options import (
    Antialias,
    Around,
    CameraFile,
    CutAway,
    Distance,
    Elevation,
    Every,
    Folder,
    Frames,
    Jobs,
    ModeChoice,
    Outputs,
    Request,
    Size,
    Up,
    poses_of,
    render_here,
    request_of,
    size_of,
)


def render(
    field: Field,
    output: Folder = Path("pictures"),
    request: Request = None,
    size: Size = None,
    mode: ModeChoice = None,
    frames: Frames = None,
    elevation: Elevation = None,
    distance: Distance = None,
    around: Around = None,
    up: Up = None,
    cameras: CameraFile = None,
    every: Every = 1,
    outputs: Outputs = None,
    antialias: Antialias = None,
    cut_away: CutAway = False,
    jobs: Jobs = None,
    description: Description = None,
    config: Config = None,
    no_config: NoConfig = False,
) -> None:
    """Render a field: colors, depths and normals from an orbit or from the cameras of a file.

    Example: **regnf render room.safetensors --around box.json --frames 8 --output pictures/**
    """
    require("engine")
    said = {
        "size": size,
        "mode": None if mode is None else mode.value,
        "frames": frames,
        "elevation_deg": elevation,
        "distance": distance,
        "up": up,
        "outputs": outputs,
        "antialias": antialias,
        "cut_away": cut_away,
    }
    poses = None if cameras is None else poses_of(cameras, every, size_of(size))
    wanted = request_of(request, said, around=around, poses=poses)
    render_here(source_of(field, description, choice_of(config, no_config)), wanted, output, jobs)
