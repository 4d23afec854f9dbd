"""``regnf convert``: a field in another format."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import TimeElapsedColumn

from regnf_cli.guard import require
from regnf_cli.options import (
    CameraAxes,
    Config,
    Description,
    Field,
    NoConfig,
    Node,
    check_output,
    choice_of,
    existing,
    folder,
    source_of,
    with_node,
)
from regnf_cli.report import err, progress, say, tell, warn
from regnf_core.errors import InvalidOptionsError
from regnf_core.field_source import FieldSource

# What is said of cameras at the command line: the options, and the entries of a description that they become.


def with_cameras(description: dict[str, Any] | None, intrinsics: str | None, axes: str | None) -> dict[str, Any] | None:
    """The description with what the options say of the cameras; itself where they say nothing.

    Raises InvalidOptionsError for intrinsics that are not four or six numbers.
    """
    said = {**({} if intrinsics is None else _numbers(intrinsics)), **({} if axes is None else {"axes": axes})}
    if not said:
        return description
    known = (description or {}).get("cameras")
    return {**(description or {}), "cameras": {**(known if isinstance(known, Mapping) else {}), **said}}


def _numbers(text: str) -> dict[str, Any]:
    words = text.split(",")
    try:
        if len(words) not in (4, 6):
            raise ValueError
        said: dict[str, Any] = {"intrinsics": [float(word) for word in words[:4]]}
        return said if len(words) == 4 else {**said, "size": [int(word) for word in words[4:]]}
    except ValueError as error:
        message = f"--intrinsics {text[:60]}: expected fx,fy,cx,cy or fx,fy,cx,cy,width,height in pixels"
        raise InvalidOptionsError(message) from error


_SUFFIXES = (".safetensors", ".glb", ".ply", ".npz")
_GRID_MOST = 1024
_IMPORTING = "importing"
_FOLLOWING = "importing and tracing the rays of the cameras: about a minute for some hundred images"


def convert(
    field: Field,
    output: Annotated[Path, typer.Argument(metavar="OUT", help="The file to write: .safetensors, .glb, .ply or .npz.")],
    resolution: Annotated[
        int, typer.Option(min=2, max=_GRID_MOST, help="Number of cells along the longest edge, for meshes and grids.")
    ] = 128,
    description: Description = None,
    config: Config = None,
    no_config: NoConfig = False,
    node: Node = None,
    images: Annotated[
        Path | None,
        typer.Option(
            help="The posed depth images from which the field was made. The regnf field file then records "
            "which parts the cameras observed.",
            parser=folder,
            metavar="FOLDER",
        ),
    ] = None,
    cameras: Annotated[
        Path | None,
        typer.Option(
            help="The poses of the cameras from whose images the field was made: transforms.json, "
            "meta_data.json, lines of poses (TUM, KITTI ...), or a folder with one pose per file. The regnf field "
            "file then records which parts the cameras observed. No image is needed.",
            parser=existing,
            metavar="PATH",
        ),
    ] = None,
    intrinsics: Annotated[
        str | None,
        typer.Option(
            help="Intrinsics of the cameras in pixels, if they are not in the file.", metavar="FX,FY,CX,CY[,W,H]"
        ),
    ] = None,
    axes: CameraAxes = None,
    transform: Annotated[
        Path | None,
        typer.Option(
            help="Of Gaussian splats: write them moved by this pose, as .ply. A JSON file with a 4 x 4 matrix, or the "
            "result.json of a registration, whose T_object_scene is used.",
            parser=existing,
            metavar="JSON",
        ),
    ] = None,
    inverse: Annotated[bool, typer.Option("--inverse", help="Move by the inverse of --transform.")] = False,
) -> None:
    """Write a field as a regnf field file (.safetensors), as the mesh of its surface (.glb, .ply) or as a dense grid
    (.npz).

    Example: **regnf convert step-000030000.ckpt chair.glb --resolution 256**
    """
    require("engine")
    check_output(output, _SUFFIXES, (cameras,))
    if (images or cameras) is not None and output.suffix.lower() != ".safetensors":
        raise InvalidOptionsError("--images and --cameras need a regnf field file (.safetensors) as the output")
    if images is not None and cameras is not None:
        raise InvalidOptionsError("--images and --cameras: give only one of them; images have more information")
    if transform is not None or inverse:
        _moved(field, output, transform, inverse)
        return
    said = with_cameras(with_node(description, node), intrinsics, None if cameras is None else axes)
    if cameras is None and (intrinsics is not None or (axes is not None and images is None)):
        raise InvalidOptionsError("--intrinsics needs --cameras; --camera-axes needs --cameras or --images")
    source = source_of(field, said, choice_of(config, no_config))
    check_output(output, _SUFFIXES, (source.file, *source.settings))
    if output.suffix.lower() == ".safetensors":
        _to_safe_field(source, output, images, cameras, opengl=axes == "opengl")
    else:
        _evaluated(source, output, resolution)


def _moved(field: Path, output: Path, transform: Path | None, inverse: bool) -> None:
    from regnf_core.moved_splats import pose_in, write_moved

    if transform is None or output.suffix.lower() != ".ply":
        raise InvalidOptionsError("--inverse needs --transform, which needs .ply as the output")
    with err.status("moving"):
        count = write_moved(field, output, pose_in(transform, inverse))
    _told(output, f"{count:,} Gaussians")


def _to_safe_field(source: FieldSource, output: Path, images: Path | None, cameras: Path | None, opengl: bool) -> None:
    from regnf_core.importing.gate.gate import FIELD_NAME, import_field
    from regnf_core.importing.run.folder import packed_cameras

    with tempfile.TemporaryDirectory(dir=output.parent, prefix=".convert-") as scratch:
        with (
            err.status(_IMPORTING if cameras is None else _FOLLOWING),
            source.naming(),
            source.packed_settings() as settings,
            nullcontext() if cameras is None else packed_cameras(cameras) as stood,
        ):
            said = source.description or None
            report = import_field(source.file, Path(scratch), said, settings=settings, cameras=stood)
        if images is not None:
            with err.status("recording which parts the cameras observed"):
                _keep_what_was_seen(Path(scratch) / FIELD_NAME, images, opengl)
        os.replace(Path(scratch) / FIELD_NAME, output)
    _told(output, f"{report.family}, {report.parameters:,} parameters")
    for why in report.why:
        if why.startswith("observed"):
            tell(why)
    for line in report.assumed:
        tell(f"assumed: {line}")
    warn(report.warnings)


def _keep_what_was_seen(field: Path, images: Path, opengl: bool) -> None:
    from regnf_data.agreement import check_agreement
    from regnf_data.sdfstudio import load_dataset
    from regnf_fit.images.observing import attach_observation

    given = load_dataset(images, opengl=opengl)
    warning = check_agreement(given)
    attach_observation(field, given)
    warn([] if warning is None else [warning])


def _evaluated(source: FieldSource, output: Path, resolution: int) -> None:
    with err.status("opening"):
        from regnf_core.loading import load_field
        from regnf_core.surface.exporting import write_grid, write_mesh

        loaded = load_field(source)
    with progress("{task.completed:,.0f} points", TimeElapsedColumn()) as bar:
        task = bar.add_task("evaluating", total=None)

        def report(points: int) -> None:
            bar.update(task, completed=points)

        if output.suffix.lower() == ".npz":
            shape = write_grid(loaded.field, output, resolution, report)
            told = f"{' x '.join(map(str, shape))} nodes"
        else:
            told = f"{write_mesh(loaded.field, output, resolution, report):,} triangles"
    _told(output, told)
    warn(loaded.notes.warnings)


def _told(output: Path, what: str) -> None:
    say(f"{output}: {what}, {output.stat().st_size / 1e6:.1f} MB")
