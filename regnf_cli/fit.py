"""``regnf fit``: a neural field from a mesh or from posed images."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import BarColumn, Progress, TextColumn

from regnf_cli.console import err, out
from regnf_cli.extras import require
from regnf_core.errors import InvalidInputError, InvalidOptionsError

_LONGEST_LABEL = 200  # of the safe format


class StartChoice(StrEnum):
    """A ball, a hollow ball round the cameras, or what the cameras' places suggest."""

    auto = "auto"
    object = "object"
    room = "room"


class DeviceChoice(StrEnum):
    """Where to compute; auto: a GPU if there is one."""

    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


def fit(
    source: Annotated[
        Path,
        typer.Argument(
            help="A mesh (glb, obj, ply, stl), or a folder of posed images with meta_data.json.", exists=True
        ),
    ],
    output: Annotated[Path, typer.Argument(help="The safe field to write, *.safetensors.")],
    iterations: Annotated[int, typer.Option(min=1, help="Training steps; more is finer.")] = 3000,
    table_log2: Annotated[int, typer.Option(min=8, max=22, help="log2 of the entries per hash level.")] = 15,
    extent: Annotated[
        float | None,
        typer.Option(
            help="Meshes: center it and scale its longest edge to this many units (up to 2 always fits). "
            "Else its own frame."
        ),
    ] = None,
    label: Annotated[str | None, typer.Option(help="A name kept in the file, up to 200 characters.")] = None,
    seed: Annotated[int, typer.Option(min=0, max=2**32 - 1)] = 0,
    hidden_width: Annotated[
        int | None, typer.Option(min=8, max=1024, help="Width of the network: 128 for meshes, 64 for images.")
    ] = None,
    snapshots: Annotated[
        str | None, typer.Option(help="Images: percents of the training to write the field after too, such as 1,3,10.")
    ] = None,
    sdfstudio: Annotated[
        Path | None,
        typer.Option(help="Images: write a checkpoint in sdfstudio's layout too, colors included (.ckpt)."),
    ] = None,
    pictures: Annotated[
        bool, typer.Option("--pictures", help="Images: draw the field early on and at the end.")
    ] = False,
    start: Annotated[StartChoice, typer.Option(help="Images: the shape to start from.")] = StartChoice.auto,
    refine_poses: Annotated[
        bool, typer.Option("--refine-poses", help="Images with depths: correct the cameras' poses with the field.")
    ] = False,
    device: Annotated[DeviceChoice, typer.Option(help="Images: where to compute.")] = DeviceChoice.auto,
) -> None:
    """Fit a neus-facto field to the exact distance of a mesh, or to posed images: minutes on two cores.

    A fit to images that was interrupted goes on from OUTPUT's .checkpoint when the same command is given again.

    Examples: **regnf fit chair.glb chair.safetensors --extent 1.0**, **regnf fit images/ chair.safetensors**
    """
    require("engine")
    _check(output, extent, label)
    if not source.is_dir():
        if (
            snapshots is not None
            or sdfstudio is not None
            or pictures
            or start is not StartChoice.auto
            or refine_poses
            or device is not DeviceChoice.auto
        ):
            named = "--snapshots, --sdfstudio, --pictures, --start, --refine-poses and --device"
            raise InvalidOptionsError(f"{named} are for images")
        settings = {"iterations": iterations} | ({} if hidden_width is None else {"hidden_width": hidden_width})
        _fit_mesh(source, output, settings, table_log2, extent, {"seed": seed, "label": label})
        return
    if extent is not None:
        raise InvalidOptionsError("--extent is for meshes: a dataset has its own frame")
    from regnf_cli.fit_images import fit_images

    choices: dict[str, Any] = {
        "iterations": iterations,
        "table_log2": table_log2,
        "start": start.value,
        "refine_poses": refine_poses,
    }
    choices |= {} if hidden_width is None else {"hidden_width": hidden_width}
    files = {"snapshots": snapshots, "sdfstudio": sdfstudio, "pictures": pictures}
    fit_images(source, output, choices, files, {"seed": seed, "label": label, "device": device.value})


def _fit_mesh(
    mesh: Path, output: Path, settings: dict[str, Any], table_log2: int, extent: float | None, rest: dict[str, Any]
) -> None:
    import numpy as np

    from regnf_core.fields.mesh import MeshField
    from regnf_fit.mesh.fit import fit_field
    from regnf_fit.mesh.options import FitOptions

    options = FitOptions(**settings)
    options = replace(options, grid=replace(options.grid, log2_table_size=table_log2))
    target = MeshField.load(mesh)
    source: dict[str, Any] = {"mesh": mesh.name}
    if extent is not None:
        low, high = target.bounds.numpy()
        if not (high > low).any():
            raise InvalidInputError("the mesh is a single point", reason="NO_SURFACE_IN_TARGET")
        T_field_mesh = np.eye(4)
        T_field_mesh[:3, :3] *= extent / (high - low).max()
        T_field_mesh[:3, 3] = -T_field_mesh[0, 0] * (low + high) / 2
        target = target.transformed(T_field_mesh)
        source["T_field_mesh"] = T_field_mesh.tolist()
    _fit_with_bar(fit_field, target, output, options, rest | {"source": source})


def _check(output: Path, extent: float | None, label: str | None) -> None:
    """Refuse before the work what would fail after it."""
    if output.suffix != ".safetensors":
        raise InvalidOptionsError(f"{output}: expected a name that ends in .safetensors")
    if not output.parent.is_dir():
        raise InvalidOptionsError(f"{output.parent}: no such folder", hint=f"Make it: mkdir -p {output.parent}")
    if extent is not None and not 0.0 < extent < math.inf:
        raise InvalidOptionsError("the extent must be positive")
    if label is not None and len(label) > _LONGEST_LABEL:
        raise InvalidOptionsError(f"the label has more than {_LONGEST_LABEL} characters")


def _fit_with_bar(fit_field: Any, target: Any, output: Path, options: Any, rest: dict[str, Any]) -> None:
    columns = TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[state]}")
    with Progress(*columns, console=err) as bar:
        task = bar.add_task("fitting", total=options.iterations, state="sampling exact distances")

        def report(iteration: int, loss: float, seconds_left: float) -> None:
            bar.update(task, completed=iteration, state=f"loss {loss:.5f}, {seconds_left:.0f} s left")

        figures = fit_field(target, output, options, progress=report, **rest)
    for name, value in asdict(figures).items():
        out.print(f"{name:<24} {value:.6g}")
