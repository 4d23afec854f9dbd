"""What is said of cameras at the command line, as entries of a description."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Any

from regnf_core.errors import InvalidOptionsError


class Axes(StrEnum):
    """Conventions of a camera's axes."""

    OPENCV = "opencv"
    OPENGL = "opengl"


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
