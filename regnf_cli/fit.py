"""``regnf fit``: a neural field from a mesh or from posed images; ``regnf fuse``: a map from posed depth images."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.progress import MofNCompleteColumn

from regnf_cli.guard import require
from regnf_cli.options import (
    CameraAxes,
    DepthUnit,
    Intrinsics,
    Layout,
    Node,
    Seed,
    check_output,
    given_of,
    is_recording,
)
from regnf_cli.report import out, progress, tell, warn
from regnf_core.errors import InvalidOptionsError

if TYPE_CHECKING:
    from regnf_data.posed_images import PosedImages
    from regnf_data.recordings.recording import Given

_LONGEST_LABEL = 200  # of the safe format


SafeField = Annotated[Path, typer.Argument(help="The regnf field file to write (.safetensors).")]
Bounds = Annotated[
    str | None,
    typer.Option(
        help="Region that the field covers, world frame (only for images). Default: the region that the images show.",
        metavar="X,Y,Z,X,Y,Z",
    ),
]
Label = Annotated[str | None, typer.Option(help="A name that is stored in the file, up to 200 characters.")]


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
    warn(warnings)


_Iterations = Annotated[
    int | None, typer.Option(min=1, help="Number of training steps. More steps give finer details. Default: 3000.")
]
_TableLog2 = Annotated[
    int | None,
    typer.Option(
        min=8,
        max=22,
        help="log2 of the entries per hash level. Default: 15; for images 15 to 18, depending on what they show.",
    ),
]
_Extent = Annotated[
    float | None,
    typer.Option(
        help="Meshes: center the mesh and scale its longest edge to this many units (at most 2 always "
        "fits). Default: its own frame."
    ),
]
_OF_IMAGES_UNSAID = (None, None, False, "auto", False, "auto", None, None, None, None)


def fit(
    source: Annotated[
        Path,
        typer.Argument(
            help="A mesh (glb, obj, ply, stl, step ...), or a recording: posed images in a layout of docs/datasets.md.",
            exists=True,
        ),
    ],
    output: SafeField,
    iterations: _Iterations = None,
    table_log2: _TableLog2 = None,
    extent: _Extent = None,
    node: Node = None,
    label: Label = None,
    seed: Seed = 0,
    hidden_width: Annotated[
        int | None, typer.Option(min=8, max=1024, help="Width of the network. Default: 128 for meshes, 64 for images.")
    ] = None,
    snapshots: Annotated[
        str | None,
        typer.Option(help="Images: also write the field after these percentages of the training, for example 1,3,10."),
    ] = None,
    sdfstudio: Annotated[
        Path | None, typer.Option(help="Images: also write a checkpoint in sdfstudio's layout, with colors (.ckpt).")
    ] = None,
    pictures: Annotated[
        bool,
        typer.Option("--pictures", help="Images: write pictures of the field, early in the training and at the end."),
    ] = False,
    start: Annotated[Literal["auto", "object", "room"], typer.Option(help="Images: the initial shape.")] = "auto",
    refine_poses: Annotated[
        bool,
        typer.Option("--refine-poses", help="Images with depths: refine the camera poses together with the field."),
    ] = False,
    device: Annotated[Literal["auto", "cpu", "cuda"], typer.Option(help="Images: the device that computes.")] = "auto",
    bounds: Bounds = None,
    depth_unit: DepthUnit = None,
    intrinsics: Intrinsics = None,
    layout: Layout = None,
    axes: CameraAxes = None,
) -> None:
    """Fit a neus-facto field to the exact distance of a mesh, or to posed images. It takes minutes on two cores.

    To continue an interrupted fit to images, run the same command again. It starts from OUTPUT's .checkpoint.

    Examples: **regnf fit chair.glb chair.safetensors --extent 1.0**, **regnf fit images/ chair.safetensors**
    """
    require("engine")
    check_field_to_write(output, label)
    if extent is not None and not 0.0 < extent < math.inf:
        raise InvalidOptionsError("the extent must be positive")
    from regnf_fit.images.fit import FitFiles, reconstruct
    from regnf_fit.mesh import fit_field, mesh_target
    from regnf_fit.options import FitOptions, ReconstructionOptions

    given = {"iterations": iterations, "hidden_width": hidden_width}
    settings: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    rest: dict[str, Any] = {"seed": seed, "label": label}
    if source.is_dir() or layout is not None or is_recording(source):
        if extent is not None:
            raise InvalidOptionsError("--extent is only for meshes: a dataset has its own frame")
        if node is not None:
            raise InvalidOptionsError("--node is only for meshes")
        wanted = ReconstructionOptions(**settings, table_log2=table_log2, start=start, refine_poses=refine_poses)
        checkpoint = output.with_suffix(".checkpoint")
        files = FitFiles(output, checkpoint, shares(snapshots), pictures=pictures, sdfstudio=sdfstudio)
        rest |= {"device": device, "source": {"dataset": source.resolve().name}}
        with _fitting() as (say, report):
            say("reading the images")
            images = _taken(source, given_of(depth_unit, intrinsics, layout, axes), bounds)
            say("preparing the rays")
            fitted = reconstruct(images, files, wanted, progress=report, **rest)
        print_report(asdict(fitted))
        return
    _require_unsaid(snapshots, sdfstudio, pictures, start, refine_poses, device, bounds, depth_unit, intrinsics, axes)
    options = FitOptions(**settings)
    if table_log2 is not None:
        options = replace(options, grid=replace(options.grid, log2_table_size=table_log2))
    target = mesh_target(source, extent, node)
    for done in target.source.get("mesh_faces", ()):
        tell(f"{source.name}: {done}")
    with _fitting() as (say, report):
        say("sampling the exact distances")
        figures = fit_field(target.field, output, options, progress=report, source=target.source, **rest)
    print_report(asdict(figures))


def _require_unsaid(*of_images: object) -> None:
    """Raises InvalidOptionsError where an option of images was given for a mesh."""
    if of_images != _OF_IMAGES_UNSAID:
        named = "--snapshots, --sdfstudio, --pictures, --start, --refine-poses, --device, --bounds, --depth-unit,"
        named += " --intrinsics, --layout and --camera-axes"
        raise InvalidOptionsError(f"{named} are only for images")


@contextmanager
def _fitting() -> Iterator[tuple[Callable[[str], None], Callable[[int, float, float], None]]]:
    """A bar: what says a state, and what takes a fit's progress, which is the share of the seconds since then."""
    with progress("{task.fields[state]}") as bar:
        task = bar.add_task("fitting", total=1.0, state="")
        started = time.monotonic()

        def say(state: str) -> None:
            nonlocal started
            started = time.monotonic()
            bar.update(task, state=state)

        def report(iteration: int, loss: float, seconds_left: float) -> None:
            elapsed = time.monotonic() - started
            state = f"iteration {iteration}, loss {loss:.5f}, {seconds_left:.0f} s left"
            bar.update(task, completed=elapsed / max(elapsed + seconds_left, 1e-9), state=state)

        yield say, report


def shares(percents: str | None) -> tuple[float, ...]:
    """Percents such as ``1,3,10`` as shares. Raises InvalidOptionsError."""
    if not percents:
        return ()
    try:
        values = tuple(float(part) / 100.0 for part in percents.split(","))
    except ValueError as error:
        raise InvalidOptionsError(f"snapshots are percentages such as 1,3,10, not {percents:.40}") from error
    if not all(0.0 < value < 1.0 for value in values):
        raise InvalidOptionsError("snapshots must be between 0 and 100 percent")
    return values


def fuse(
    recording: Annotated[
        Path,
        typer.Argument(
            help="Posed depth images: a folder in a layout of docs/datasets.md, or a bag.",
            exists=True,
        ),
    ],
    output: SafeField,
    voxel: Annotated[
        float | None,
        typer.Option(help="Voxel size in the recording's unit. Default: the width of a pixel at the surface."),
    ] = None,
    truncation: Annotated[
        float | None,
        typer.Option(
            min=1.0,
            max=1000.0,
            help="TSDF truncation in voxels. Default: 4, or more for noisy depth (6 standard deviations "
            "between images).",
        ),
    ] = None,
    label: Label = None,
    bounds: Bounds = None,
    depth_unit: DepthUnit = None,
    intrinsics: Intrinsics = None,
    layout: Layout = None,
    axes: CameraAxes = None,
) -> None:
    """Fuse posed depth images into a TSDF map with its observation. It takes seconds; a fit takes minutes.

    Images that contradict each other are refused, for example if a unit or an axis is wrong. The message has the
    correction.

    Example: **regnf fuse room-images room.safetensors**
    """
    require("engine")
    check_field_to_write(output, label)
    if voxel is not None and not 1e-9 <= voxel <= 1e6:
        raise InvalidOptionsError("the voxel size must be between 1e-9 and 1e6")
    from regnf_fit.images.fusion import FusionOptions, fuse_images

    said = given_of(depth_unit, intrinsics, layout, axes)
    with progress(MofNCompleteColumn()) as bar:
        task = bar.add_task("reading the images", total=None)
        taken = _taken(recording, said, bounds, lambda done, total: bar.update(task, completed=done, total=total))
        bar.update(task, description="fusing", completed=0, total=len(taken))
        report = fuse_images(
            taken,
            output,
            FusionOptions(voxel, truncation),
            progress=lambda done: bar.update(task, completed=done),
            label=label,
            source={"dataset": recording.resolve().name},
        )
        bar.update(task, completed=len(taken))
    print_report(asdict(report))


def _taken(
    source: Path, said: Given, bounds: str | None, report: Callable[[int, int], None] | None = None
) -> PosedImages:
    """The images of a recording; what was taken for granted is said."""
    import numpy as np

    from regnf_data.recordings.images import images_of

    box = None
    if bounds is not None:
        try:
            box = np.array([float(one) for one in bounds.split(",")]).reshape(2, 3)
        except ValueError as error:
            message = f"--bounds {bounds[:200]}: expected six numbers, the lowest and the highest corner"
            raise InvalidOptionsError(message, hint="Write for example --bounds=-1,-1,0,1,1,2.") from error
    taken = images_of(source, said, box, progress=report)
    for note in taken.notes:
        tell(f"note: {note}")
    return taken.images
