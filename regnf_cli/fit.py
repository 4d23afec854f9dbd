"""``regnf fit``: a neural field from a mesh or from posed images."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from rich.progress import BarColumn, Progress, TextColumn

from regnf_cli.camera_options import Axes, CameraAxes
from regnf_cli.console import err
from regnf_cli.extras import require
from regnf_cli.fit_options import (
    Device,
    DeviceChoice,
    Extent,
    HiddenWidth,
    Iterations,
    Label,
    Pictures,
    RefinePoses,
    SafeField,
    Sdfstudio,
    Snapshots,
    Source,
    Start,
    StartChoice,
    TableLog2,
    check_field_to_write,
    print_report,
)
from regnf_cli.options import Seed
from regnf_core.errors import InvalidOptionsError

_OF_IMAGES_UNSAID = (None, None, False, StartChoice.auto, False, DeviceChoice.auto, None)


def fit(
    source: Source,
    output: SafeField,
    iterations: Iterations = None,
    table_log2: TableLog2 = None,
    extent: Extent = None,
    label: Label = None,
    seed: Seed = 0,
    hidden_width: HiddenWidth = None,
    snapshots: Snapshots = None,
    sdfstudio: Sdfstudio = None,
    pictures: Pictures = False,
    start: Start = StartChoice.auto,
    refine_poses: RefinePoses = False,
    device: Device = DeviceChoice.auto,
    axes: CameraAxes = None,
) -> None:
    """Fit a neus-facto field to the exact distance of a mesh, or to posed images: minutes on two cores.

    A fit to images that was interrupted goes on from OUTPUT's .checkpoint when the same command is given again.

    Examples: **regnf fit chair.glb chair.safetensors --extent 1.0**, **regnf fit images/ chair.safetensors**
    """
    require("engine")
    check_field_to_write(output, label)
    if extent is not None and not 0.0 < extent < math.inf:
        raise InvalidOptionsError("the extent must be positive")
    given = {"iterations": iterations, "hidden_width": hidden_width}
    settings: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    rest = {"seed": seed, "label": label}
    if not source.is_dir():
        if (snapshots, sdfstudio, pictures, start, refine_poses, device, axes) != _OF_IMAGES_UNSAID:
            named = "--snapshots, --sdfstudio, --pictures, --start, --refine-poses, --device and --camera-axes"
            raise InvalidOptionsError(f"{named} are for images")
        _fit_mesh(source, output, settings, table_log2, extent, rest)
        return
    if extent is not None:
        raise InvalidOptionsError("--extent is for meshes: a dataset has its own frame")
    from regnf_cli.fit_images import fit_images

    settings |= {"table_log2": table_log2, "start": start.value, "refine_poses": refine_poses}
    files = {"snapshots": snapshots, "sdfstudio": sdfstudio, "pictures": pictures, "opengl": axes == Axes.OPENGL}
    fit_images(source, output, settings, files, rest | {"device": device.value})


def _fit_mesh(
    mesh: Path,
    output: Path,
    settings: dict[str, Any],
    table_log2: int | None,
    extent: float | None,
    rest: dict[str, Any],
) -> None:
    from regnf_fit.mesh.file import mesh_target
    from regnf_fit.mesh.fit import fit_field
    from regnf_fit.mesh.options import FitOptions

    options = FitOptions(**settings)
    if table_log2 is not None:
        options = replace(options, grid=replace(options.grid, log2_table_size=table_log2))
    target = mesh_target(mesh, extent)
    for done in target.source.get("mesh_faces", ()):
        err.print(f"{mesh.name}: {done}", markup=False, soft_wrap=True)
    _fit_with_bar(fit_field, target.field, output, options, rest | {"source": target.source})


def _fit_with_bar(fit_field: Any, target: Any, output: Path, options: Any, rest: dict[str, Any]) -> None:
    columns = TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[state]}")
    with Progress(*columns, console=err) as bar:
        task = bar.add_task("fitting", total=options.iterations, state="sampling exact distances")

        def report(iteration: int, loss: float, seconds_left: float) -> None:
            bar.update(task, completed=iteration, state=f"loss {loss:.5f}, {seconds_left:.0f} s left")

        figures = fit_field(target, output, options, progress=report, **rest)
    print_report(asdict(figures))
