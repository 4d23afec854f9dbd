"""``regnf fuse``: a map of truncated distances from posed depth images."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from regnf_cli.convert import Axes, CameraAxes
from regnf_cli.fit import Label, SafeField, check_field_to_write, print_report
from regnf_cli.guard import require
from regnf_cli.report import err
from regnf_core.errors import InvalidOptionsError

Images = Annotated[
    Path, typer.Argument(help="A folder of posed RGB-D images with meta_data.json.", exists=True, file_okay=False)
]
Voxel = Annotated[
    float | None,
    typer.Option(help="From node to node, the dataset's units; without it as wide as a pixel is at its surface."),
]
Truncation = Annotated[
    float | None,
    typer.Option(
        min=1.0, max=1000.0, help="Voxels; without it 4, or 6 standard deviations of the depths from image to image."
    ),
]


def fuse(
    images: Images,
    output: SafeField,
    voxel: Voxel = None,
    truncation: Truncation = None,
    label: Label = None,
    axes: CameraAxes = None,
) -> None:
    """Fuse posed depth images to a map, with what they have seen of it: seconds, where a fit takes minutes.

    Example: **regnf fuse room-images room.safetensors**
    """
    require("engine")
    check_field_to_write(output, label)
    if voxel is not None and not 1e-9 <= voxel <= 1e6:
        raise InvalidOptionsError("the voxel's edge must lie between 1e-9 and 1e6")
    from regnf_data.sdfstudio import load_dataset
    from regnf_fit.images.fusion import FusionOptions, fuse_images

    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()
    with Progress(*columns, console=err) as bar:
        task = bar.add_task("reading the images", total=None)
        given = load_dataset(images, opengl=axes == Axes.OPENGL)
        bar.update(task, description="fusing", total=len(given))
        report = fuse_images(
            given,
            output,
            FusionOptions(voxel, truncation),
            progress=lambda done: bar.update(task, completed=done),
            label=label,
            source={"dataset": images.resolve().name},
        )
        bar.update(task, completed=len(given))
    print_report(asdict(report))
