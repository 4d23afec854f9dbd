"""Recordings: files, folders and single frames of a depth camera, and the upload to the service."""

from __future__ import annotations

import base64
import io
import json
import os
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from regnf_client.answers import checked, parsed
from regnf_client.fields import PIECE_BYTES, ready, send_pieces
from regnf_client.models import Field
from regnf_client.steps import Asking, Flow, work
from regnf_core.detections.images import is_image_detection, plain_values, read_detection
from regnf_core.detections.parsing import detection_of
from regnf_core.importing.recording_description import RecordingDescription
from regnf_core.importing.upload_description import described
from regnf_core.library_folder import digest_of
from regnf_core.texts import json_value

_WRITTEN = (1980, 1, 1, 0, 0, 0)
Image = Any
"""The path of an image file, its bytes, or an array."""


def upload(
    asking: Asking, path: Path, label: str | None, description: Mapping[str, Any] | None, wait: bool
) -> Flow[Field]:
    """Upload a recording. It is not sent again if the service has it. Raises ServiceError, FieldFormatError."""
    params = {} if label is None else {"label": label}
    said = described(RecordingDescription, description).non_default()
    with _as_file(path) as file:
        sha256, size = (yield from work(partial(digest_of, file))), file.stat().st_size
        answer = yield from asking.call("GET", f"/recordings/{sha256}")
        is_held = answer.status_code != 404 and parsed(Field, checked(answer)).state != "rejected"
        form: dict[str, Any] = {"upload": (None, sha256)}
        if not is_held and size <= PIECE_BYTES:
            form = {"file": (path.name, (yield from work(file.read_bytes)))}
        elif not is_held:
            yield from send_pieces(asking, file, f"/fields/{sha256}", size)
        if said or not is_held:
            form |= {"description": (None, json.dumps(said))} if said else {}
            answer = yield from asking.call("POST", "/recordings", params=params, files=form)
    found = parsed(Field, checked(answer))
    return (yield from ready(asking, found)) if wait else found


@contextmanager
def _as_file(path: Path) -> Iterator[Path]:
    """A file as it is; of a folder an archive, which is the same for the same files."""
    if not path.is_dir():
        yield path
        return
    with TemporaryDirectory(prefix="regnf-") as folder:
        packed = Path(folder) / f"{path.name}.zip"
        with zipfile.ZipFile(packed, "w") as archive:
            for one in sorted(path.rglob("*")):
                if one.is_file():
                    name = zipfile.ZipInfo(one.relative_to(path).as_posix(), _WRITTEN)
                    with one.open("rb") as source, archive.open(name, "w", force_zip64=True) as target:
                        while block := source.read(1 << 20):
                            target.write(block)
        yield packed


def frame_form(depth: Image, camera: Any, color: Image = None, more: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """The parts of a frame. camera: members of the part `camera`, the path of its file, or K: (3, 3) or fx, fy, cx, cy
    · more: further members, such as ``depth_unit`` and ``T_world_camera``."""
    if isinstance(camera, str | os.PathLike):
        camera = json_value(Path(camera).read_bytes(), f"camera {camera}: ")
    if not isinstance(camera, Mapping):
        camera = {"K": np.asarray(camera).tolist()}
    said = {**camera, **{name: np.asarray(value).tolist() for name, value in (more or {}).items() if value is not None}}
    form: dict[str, Any] = {"depth": ("depth", _bytes(depth)), "camera": (None, json.dumps(said))}
    return form if color is None else form | {"color": ("color", _bytes(color))}


def _bytes(image: Image) -> bytes:
    if isinstance(image, bytes):
        return image
    if isinstance(image, str | os.PathLike):
        return Path(image).read_bytes()
    array = np.asarray(image)
    if array.ndim == 3:
        return png_of(array)
    held = io.BytesIO()
    np.save(held, array)
    return held.getvalue()


def png_of(array: Any) -> bytes:
    """A PNG of (H, W) or (H, W, 3), eight bits per channel; true is 255."""
    pixels = np.asarray(array)
    pixels = (pixels * np.uint8(255) if pixels.dtype == np.bool_ else pixels).astype(np.uint8)
    height, width = pixels.shape[:2]
    rows = np.zeros((height, pixels.size // height + 1), np.uint8)  # each begins with the filter that it has: none
    rows[:, 1:] = pixels.reshape(height, -1)
    chunks = (
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2 if pixels.ndim == 3 else 0, 0, 0, 0)),
        (b"IDAT", zlib.compress(rows.tobytes(), 1)),
        (b"IEND", b""),
    )
    framed = (
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(framed)


def detection_body(detection: Any) -> Any:
    """The detection in a request: a box, or the object in images with masks as PNGs. Raises InvalidDetectionError."""
    folder = Path()
    if isinstance(detection, str | os.PathLike) and Path(detection).is_file():
        folder = Path(detection).parent
        detection = json_value(Path(detection).read_bytes(), f"detection {detection}: ")
    if not is_image_detection(detection):
        return detection_of(detection).canonical()
    found = plain_values(read_detection(detection, None, folder))
    return [one | {"mask": _mask(one["mask"])} if "mask" in one else one for one in found]


def _mask(mask: Any) -> Any:
    """Arrays as PNGs."""
    return base64.b64encode(png_of(np.asarray(mask) > 0)).decode() if hasattr(mask, "tolist") else mask
