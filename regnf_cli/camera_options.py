"""What is said of cameras at the command line: the options, and the entries of a description that they become."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from regnf_cli.paths import existing, folder
from regnf_core.errors import InvalidOptionsError


class Axes(StrEnum):
    """Conventions of a camera's axes."""

    OPENCV = "opencv"
    OPENGL = "opengl"


Images = Annotated[
    Path | None,
    typer.Option(
        help="The posed depth images that the field was fitted to: the safe field then records which parts the "
        "cameras observed.",
        parser=folder,
        metavar="FOLDER",
    ),
]
Cameras = Annotated[
    Path | None,
    typer.Option(
        help="Where the cameras stood whose images the field was made from: transforms.json, meta_data.json, "
        "poses of TUM, or a folder with a pose a file. The safe field then records which parts they observed; no "
        "image is needed.",
        parser=existing,
        metavar="PATH",
    ),
]
Intrinsics = Annotated[
    str | None,
    typer.Option(help="Of the cameras, in pixels, where their file does not say.", metavar="FX,FY,CX,CY[,W,H]"),
]
CameraAxes = Annotated[
    Axes | None,
    typer.Option(
        "--camera-axes", help="Where cameras look: opencv along z, opengl against z. By default the file's own way."
    ),
]


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
