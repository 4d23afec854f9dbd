"""The options of ``regnf fit``, some of ``regnf fuse`` too."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from regnf_cli.console import err, out
from regnf_cli.paths import check_output
from regnf_core.errors import InvalidOptionsError

_LONGEST_LABEL = 200  # of the safe format


class StartChoice(StrEnum):
    """A ball, a hollow ball round the bounds, or what the images suggest."""

    auto = "auto"
    object = "object"
    room = "room"


class DeviceChoice(StrEnum):
    """Where to compute; auto: a GPU if there is one."""

    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


# of both kinds of sources

Source = Annotated[
    Path,
    typer.Argument(help="A mesh (glb, obj, ply, stl), or a folder of posed images with meta_data.json.", exists=True),
]
SafeField = Annotated[Path, typer.Argument(help="The safe field to write, *.safetensors.")]
Iterations = Annotated[
    int | None,
    typer.Option(min=1, help="Training steps; more is finer. Without it 3000."),
]
TableLog2 = Annotated[
    int | None,
    typer.Option(
        min=8, max=22, help="log2 of the entries per hash level. Without it 15, of images 15 to 18 by what they show."
    ),
]
Label = Annotated[str | None, typer.Option(help="A name kept in the file, up to 200 characters.")]
HiddenWidth = Annotated[
    int | None, typer.Option(min=8, max=1024, help="Width of the network: 128 for meshes, 64 for images.")
]

# of meshes

Extent = Annotated[
    float | None,
    typer.Option(
        help="Meshes: center it and scale its longest edge to this many units (up to 2 always fits). "
        "Else its own frame."
    ),
]

# of images

Snapshots = Annotated[
    str | None, typer.Option(help="Images: percents of the training to write the field after too, such as 1,3,10.")
]
Sdfstudio = Annotated[
    Path | None,
    typer.Option(help="Images: write a checkpoint in sdfstudio's layout too, colors included (.ckpt)."),
]
Pictures = Annotated[bool, typer.Option("--pictures", help="Images: draw the field early on and at the end.")]
Start = Annotated[StartChoice, typer.Option(help="Images: the shape to start from.")]
RefinePoses = Annotated[
    bool, typer.Option("--refine-poses", help="Images with depths: correct the cameras' poses with the field.")
]
Device = Annotated[DeviceChoice, typer.Option(help="Images: where to compute.")]


def check_field_to_write(output: Path, label: str | None) -> None:
    """Refuse before the work what would fail after it. Raises InvalidOptionsError."""
    check_output(output, (".safetensors",))
    if label is not None and len(label) > _LONGEST_LABEL:
        raise InvalidOptionsError(f"the label has more than {_LONGEST_LABEL} characters")


def print_report(figures: dict[str, Any]) -> None:
    """The figures of a fit or a fusion, a line each, and its warnings."""
    warnings = figures.pop("warnings", ())
    for name, value in figures.items():
        out.print(f"{name:<24} {'none' if value is None else format(value, '.6g')}")
    for warning in warnings:
        err.print(f"warning: {warning}", markup=False, soft_wrap=True)
