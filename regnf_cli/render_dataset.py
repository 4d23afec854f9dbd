"""``regnf render-dataset``: posed RGB-D images of meshes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.progress import MofNCompleteColumn, TimeRemainingColumn

from regnf_cli.guard import require
from regnf_cli.report import progress, say
from regnf_core.errors import InvalidOptionsError

if TYPE_CHECKING:
    from regnf_data.composing import RenderOptions
    from regnf_data.posed_images import PosedImages

_LARGEST_EDGE = 4096


Trajectory = Literal["long", "short", "single"]


def render_dataset(
    source: Annotated[
        Path,
        typer.Argument(
            help="A mesh (glb, obj, ply, stl; meters, z up) or a layout (.json).", exists=True, dir_okay=False
        ),
    ],
    output: Annotated[Path, typer.Argument(metavar="OUT", help="The folder to make, in the sdfstudio data format.")],
    meshes: Annotated[
        Path | None, typer.Option(help="The folder with the layout's meshes.", exists=True, file_okay=False)
    ] = None,
    trajectory: Annotated[Trajectory, typer.Option(help="All round, a walk past, or one bad view.")] = "long",
    instance: Annotated[str | None, typer.Option(help="Which of the layout's instances a single view shows.")] = None,
    frames: Annotated[
        int | None, typer.Option(min=1, max=10_000, help="Images; else 60 or 20 of a mesh, 240 or 60 of a layout.")
    ] = None,
    width: Annotated[int, typer.Option(min=8, max=_LARGEST_EDGE)] = 160,
    height: Annotated[int, typer.Option(min=8, max=_LARGEST_EDGE)] = 120,
    noise: Annotated[bool, typer.Option(help="A depth camera's errors, or exact depths.")] = True,
    units_per_meter: Annotated[
        float | None, typer.Option(help="World units a meter; else the layout's, or 1 for a mesh.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, max=2**32 - 1, help="Of the noise.")] = 0,
) -> None:
    """Render posed RGB-D images of a mesh or of a furnished room, with boxes and true transforms.

    Example: **regnf render-dataset chair.glb chair-images**
    """
    require("engine")
    from regnf_data.composing import RenderOptions
    from regnf_data.rendering import DepthSensor
    from regnf_data.sdfstudio import check_target, write_dataset

    layout = source.suffix.lower() == ".json"
    _check(layout, meshes, trajectory, instance, units_per_meter)
    check_target(output)
    options = RenderOptions(
        trajectory=trajectory, frames=frames, size=(height, width), sensor=DepthSensor() if noise else None, seed=seed
    )
    images = _rendered(source, meshes, instance, units_per_meter, options)
    write_dataset(images, output)
    megabytes = sum(path.stat().st_size for path in output.iterdir()) / 1e6
    names = ", ".join(each.label for each in images.instances)
    say(f"{output}: {len(images)} images of {names}, {megabytes:.1f} MB")


def _check(
    layout: bool, meshes: Path | None, trajectory: Trajectory, instance: str | None, units_per_meter: float | None
) -> None:
    if layout and meshes is None:
        raise InvalidOptionsError("a layout needs --meshes, the folder with its meshes")
    if not layout and (meshes is not None or instance is not None):
        raise InvalidOptionsError("--meshes and --instance go with a layout (.json)")
    if layout and (trajectory == "single") != (instance is not None):
        raise InvalidOptionsError("a layout's single view needs --instance, and nothing else does")
    if units_per_meter is not None and not 1e-6 <= units_per_meter <= 1e6:
        raise InvalidOptionsError("the units per meter must lie between 1e-6 and 1e6")


def _rendered(
    source: Path, meshes: Path | None, instance: str | None, units_per_meter: float | None, options: RenderOptions
) -> PosedImages:
    from regnf_data.composing import render_object, render_room
    from regnf_data.layouts import read_layout

    with progress(MofNCompleteColumn(), TimeRemainingColumn()) as bar:
        task = bar.add_task("rendering", total=None)

        def report(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)

        if meshes is None:
            return render_object(source, options, units_per_meter=units_per_meter or 1.0, progress=report)
        layout = read_layout(source, meshes)
        return render_room(layout, options, units_per_meter=units_per_meter, instance=instance, progress=report)
