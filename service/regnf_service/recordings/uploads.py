"""A recording on its way into the blob store: a file as it is, or one frame in parts, joined while it streams.

The parts of a frame become one uncompressed zip file without times or owners, so the same parts in the same order are
the same recording. No image is decoded here.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import IO, Any

from regnf_core.importing.containers.sniff import HEAD_BYTES, RECORDINGS, RUN_ARCHIVES, sniff_format
from regnf_service.concurrency import Claim
from regnf_service.fields.ingest import Beside
from regnf_service.fields.uploads import Received, Upload
from regnf_service.problem import Problem
from regnf_service.services import Services
from regnf_state.records import RECORDING, FieldRecord

FRAME_BYTES = 256 << 20
"""Of all parts of a frame."""
CAMERA_BYTES = 64 * 1024
_FORMATS = RUN_ARCHIVES | {"sqlite", "safetensors"}
_WRITTEN = (1980, 1, 1, 0, 0, 0)
_IMAGES: dict[str, dict[bytes, str]] = {
    "depth": {
        b"\x89PNG": ".png",
        b"II*\0": ".tiff",
        b"MM\0*": ".tiff",
        b"\x93NUM": ".npy",
        b"\x76\x2f\x31\x01": ".exr",
    },
    "color": {b"\x89PNG": ".png", b"\xff\xd8\xff": ".jpg", b"BM": ".bmp", b"RIFF": ".webp"},
}
"""How images of each part begin, and the endings of their names in the zip."""
_MAGIC_BYTES = 4


@dataclass(frozen=True)
class AsRecording(Beside):
    """What makes an upload a recording. name: for people · said: entries of a RecordingDescription; ``after`` and
    ``frame`` of a frame that is added to another recording."""

    name: str | None = None
    said: Mapping[str, Any] = field(default_factory=dict)
    is_nothing = False

    @property
    def label(self) -> str | None:
        return self.name

    def function(self) -> dict[str, Any]:
        return {"as": RECORDING, **self.said}

    def is_function_of(self, known: FieldRecord) -> bool:
        """Where nothing is said, any recording of the same bytes is meant."""
        return known.is_recording and (not self.said or super().is_function_of(known))


class RecordingUpload(Upload):
    """A file: an archive, a bag, or a stored recording."""

    def _recognize(self) -> None:
        if sniff_format(bytes(self._pending[:HEAD_BYTES])) not in _FORMATS and not self._pending.startswith(RECORDINGS):
            raise Problem("RECORDING_NOT_RECOGNIZED")
        self._recognized = True


class FrameUpload(Upload):
    """One frame: ``images`` are the sinks of a form, and ``finish_frame`` ends the zip file."""

    def __init__(self, services: Services, claim: Claim) -> None:
        super().__init__(services, claim, min(FRAME_BYTES, services.settings.max_upload_bytes))
        self._pipe = _Pipe()
        self._zip = zipfile.ZipFile(self._pipe, "w")  # type: ignore[call-overload]
        self._file: IO[bytes] | None = None
        self._recognized = True
        self.images = {name: _Image(self, name) for name in _IMAGES}

    async def __aexit__(self, *what: object) -> None:
        self.begin_file(None)
        self._zip.close()
        await super().__aexit__(*what)

    def begin_file(self, name: str | None) -> None:
        """What is written from here on is the file ``name``; None: the one before has ended."""
        if self._file is not None:
            self._file.close()
        self._file = None if name is None else self._zip.open(zipfile.ZipInfo(name, _WRITTEN), "w")

    async def write(self, data: bytes | bytearray) -> None:
        """Raises Problem as ``feed`` does."""
        assert self._file is not None, "a file was begun"
        self._file.write(data)
        await self.feed(self._pipe.take())

    async def finish_frame(self, texts: Mapping[str, bytes]) -> Received:
        """The whole file, with these files behind the images. Raises Problem as ``feed`` does."""
        for image in self.images.values():
            image.require_whole()
        for name, text in texts.items():
            self.begin_file(name)
            await self.write(text)
        self.begin_file(None)
        self._zip.close()
        await self.feed(self._pipe.take())
        return await self.finish()


class _Pipe(bytearray):
    """What a zip file is written into."""

    def write(self, data: bytes) -> int:
        self.extend(data)
        return len(data)

    def flush(self) -> None:
        """Nothing waits."""

    def take(self) -> bytes:
        held = bytes(self)
        self.clear()
        return held


class _Image:
    """The sink of one image, whose first bytes say the ending of its file's name."""

    def __init__(self, frame: FrameUpload, name: str) -> None:
        self._frame, self._name = frame, name
        self._head: bytearray | None = None

    def begin(self, filename: str) -> None:  # noqa: ARG002 -- its bytes say what it is
        self._head = bytearray()
        self._frame.begin_file(None)

    async def feed(self, data: bytes | bytearray) -> None:
        """Raises Problem RECORDING_NOT_RECOGNIZED, and as ``Upload.feed`` does."""
        if self._head is not None:
            data = self._head = self._head + data
            if len(data) < _MAGIC_BYTES:
                return
            ending = next((end for magic, end in _IMAGES[self._name].items() if data.startswith(magic)), None)
            if ending is None:
                self.require_whole()
            self._head = None
            self._frame.begin_file(f"{self._name}{ending}")
        await self._frame.write(data)

    def require_whole(self) -> None:
        """Raises Problem for an image that came and has no bytes, or too few to be one."""
        if self._head is not None:
            known = ", ".join(dict.fromkeys(_IMAGES[self._name].values()))
            raise Problem(
                "RECORDING_NOT_RECOGNIZED", f"The part `{self._name}` is not an image of these types: {known}."
            )
