"""A recording on its way into the blob store: a file as it is, or one frame in parts, joined while it streams.

The parts of a frame become one uncompressed zip file without times or owners, so the same parts in the same order are
the same recording. No image is decoded here.
"""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import IO, Any

from regnf_core.importing.containers.sniff import HEAD_BYTES, RUN_ARCHIVES, explain_refusal, sniff_format
from regnf_service.concurrency import Claim
from regnf_service.fields.ingest import Beside
from regnf_service.fields.uploads import Received, Upload
from regnf_service.problem import Problem
from regnf_service.services import Services
from regnf_state.records import RECORDING

FRAME_BYTES = 256 << 20
"""Of all parts of a frame."""
CAMERA_BYTES = 64 * 1024
NAME_BYTES = 400
_RECORDINGS = RUN_ARCHIVES | {"sqlite", "safetensors"}
_BAGS = (b"\x89MCAP0\r\n", b"#ROSBAG V2.0\n")
_WRITTEN = (1980, 1, 1, 0, 0, 0)
_ENDINGS: dict[str, dict[bytes, str]] = {
    "depth": {b"\x89PNG": ".png", b"II*\0": ".tiff", b"MM\0*": ".tiff", b"\x93NUM": ".npy"},
    "color": {b"\x89PNG": ".png", b"\xff\xd8\xff": ".jpg", b"BM": ".bmp", b"RIFF": ".webp"},
}
"""Of the files in the zip, by how the images begin."""
_FORMATS = {"depth": "a PNG, a TIFF or a .npy file", "color": "a PNG, a JPEG, a BMP or a WebP file"}
_MAGIC_BYTES = 4
_NAME = re.compile(r"[A-Za-z0-9._-]{1,100}")


@dataclass(frozen=True)
class AsRecording(Beside):
    """What makes an upload a recording. name: for people · said: ``after`` and ``frame`` of a frame that is added to
    another recording."""

    name: str | None = None
    said: Mapping[str, Any] = field(default_factory=dict)

    @property
    def is_nothing(self) -> bool:
        return False

    @property
    def label(self) -> str | None:
        return self.name

    def function(self) -> dict[str, Any]:
        return {"as": RECORDING, **self.said}


class RecordingUpload(Upload):
    """A file: an archive, a bag, or a stored recording."""

    def _recognize(self) -> None:
        head = bytes(self._pending[:HEAD_BYTES])
        if sniff_format(head) not in _RECORDINGS and not head.startswith(_BAGS):
            _, sentence = explain_refusal(head)
            what = "" if head[:4] in _ENDINGS["depth"] else f"The file is {sentence}."
            raise Problem("RECORDING_NOT_RECOGNIZED", what or None)
        self._recognized = True


class _Pipe:
    """What a zip file is written into."""

    def __init__(self) -> None:
        self._held = bytearray()

    def write(self, data: bytes) -> int:
        self._held += data
        return len(data)

    def flush(self) -> None:
        """Nothing waits."""

    def take(self) -> bytearray:
        held, self._held = self._held, bytearray()
        return held


class FrameUpload(Upload):
    """One frame: ``parts`` are the sinks of a form, and ``finish_frame`` ends the zip file."""

    def __init__(self, services: Services, claim: Claim) -> None:
        super().__init__(services, claim, min(FRAME_BYTES, services.settings.max_upload_bytes))
        self._pipe = _Pipe()
        self._zip = zipfile.ZipFile(self._pipe, "w")  # type: ignore[call-overload]
        self._entry: IO[bytes] | None = None
        self.parts = {name: _Image(self, name) for name in _ENDINGS}
        self._recognized = True

    async def __aexit__(self, *what: object) -> None:
        self.begin_file(None)
        self._zip.close()
        await super().__aexit__(*what)

    def begin_file(self, name: str | None) -> None:
        """What is written from here on is the file ``name``; None: the one before has ended."""
        if self._entry is not None:
            self._entry.close()
        self._entry = None if name is None else self._zip.open(zipfile.ZipInfo(name, _WRITTEN), "w")

    async def write(self, data: bytes | bytearray) -> None:
        """Raises Problem as ``feed`` does."""
        assert self._entry is not None, "a file was begun"
        self._entry.write(data)
        await self.feed(self._pipe.take())

    async def finish_frame(self, camera: bytes, also: Mapping[str, Any] | None = None) -> Received:
        """The whole file. Raises Problem RECORDING_NOT_RECOGNIZED and as ``feed`` does."""
        for image in self.parts.values():
            image.check()
        texts = {"camera.json": camera} | ({} if also is None else {"frame.json": json.dumps(also).encode()})
        for name, text in texts.items():
            self.begin_file(name)
            await self.write(text)
        self.begin_file(None)
        self._zip.close()
        await self.feed(self._pipe.take())
        return await self.finish()


class _Image:
    """The sink of one image, whose first bytes say the ending of its file's name."""

    def __init__(self, frame: FrameUpload, name: str) -> None:
        self._frame, self._name = frame, name
        self._head: bytearray | None = bytearray()
        self.came = False

    def begin(self, filename: str) -> None:  # noqa: ARG002 -- its bytes say what it is
        self.came = True
        self._frame.begin_file(None)

    async def feed(self, data: bytes | bytearray) -> None:
        if self._head is not None:
            self._head += data
            if len(self._head) < _MAGIC_BYTES:
                return
            data, self._head = self._head, None
            endings = (ending for magic, ending in _ENDINGS[self._name].items() if data.startswith(magic))
            ending = next(endings, None)
            if ending is None:
                raise self._refusal()
            self._frame.begin_file(self._name + ending)
        await self._frame.write(data)

    def check(self) -> None:
        """Raises Problem for an image that came and has no bytes, or too few to be one."""
        if self.came and self._head is not None:
            raise self._refusal()

    def _refusal(self) -> Problem:
        return Problem("RECORDING_NOT_RECOGNIZED", f"The part `{self._name}` is not {_FORMATS[self._name]}.")


def frame_name(text: bytes) -> str:
    """The name of a frame that is added. Raises Problem INVALID_REQUEST."""
    name = text.decode("utf-8", "replace").strip()
    if not _NAME.fullmatch(name):
        raise Problem("INVALID_REQUEST", "The part `name` has 1 to 100 letters, digits, dots, hyphens and underscores.")
    return name
