"""A frame of a stored recording as a picture, of the plain arrays that the import has left: nothing is decoded."""

from __future__ import annotations

import io
import json
from typing import Any, BinaryIO

from regnf_core.detections.images import place_of_frame
from regnf_service.problem import Problem

_MOST_HEADER_BYTES = 32 << 20
_FAST = 1
"""Compression of the PNG: a person waits for it."""


def frame_picture(file: BinaryIO, wanted: str) -> bytes:
    """The PNG of the frame of this name, with or without its ending, or of this number: its color image, or its depth
    as gray, brighter where it is farther and black where nothing was measured. Blocking.

    file: a stored recording, see regnf_data.recordings.stored. Raises Problem RECORDING_FRAME_NOT_FOUND.
    """
    from PIL import Image

    length = int.from_bytes(file.read(8), "little")
    header = json.loads(file.read(min(length, _MOST_HEADER_BYTES)))
    names = json.loads(header["__metadata__"]["recording"])["names"]
    if (number := place_of_frame(names, wanted)) is None:
        raise Problem("RECORDING_FRAME_NOT_FOUND")
    for kind in ("color", "depth"):
        if kind in header:
            shape, (begin, end) = header[kind]["shape"], header[kind]["data_offsets"]
            size = (end - begin) // shape[0]
            file.seek(8 + length + begin + number * size)
            data = file.read(size)
            if kind == "color" and not any(data):
                continue  # this frame alone has none
            break
    image = Image.frombytes("RGB" if kind == "color" else "I;16", (shape[2], shape[1]), data)
    if kind == "depth":
        steps = image.convert("I")
        ends: Any = steps.getextrema()
        farthest = max(1, ends[1])
        image = steps.point(lambda step: step * (255.0 / farthest)).convert("L")
    held = io.BytesIO()
    image.save(held, "PNG", compress_level=_FAST)
    return held.getvalue()
