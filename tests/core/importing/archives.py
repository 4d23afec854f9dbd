"""Archives and pickles made by hand, sound ones and bad ones, byte by byte."""

from __future__ import annotations

import io
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from regnf_core.errors import FieldFormatError

STOP = b"."
PICKLE_OF_NOTHING = b"\x80\x02}."


def zip_bytes(entries: list[tuple[str, bytes]], compression: int = zipfile.ZIP_STORED) -> bytes:
    """A zip file as Python writes it: sizes in the local headers, no descriptors, no gaps."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as archive:
        for name, data in entries:
            archive.writestr(zipfile.ZipInfo(name), data, compress_type=compression)
    return buffer.getvalue()


def torch_zip(pickle: bytes = PICKLE_OF_NOTHING, storages: dict[str, bytes] | None = None) -> bytes:
    """An archive as torch.save lays it out, around any pickle."""
    entries = [("archive/data.pkl", pickle), ("archive/byteorder", b"little")]
    entries += [(f"archive/data/{key}", data) for key, data in (storages or {}).items()]
    return zip_bytes([*entries, ("archive/version", b"3\n")])


def central_header_at(data: bytes, index: int) -> int:
    """Where the central header number ``index`` begins."""
    (at,) = struct.unpack_from("<I", data, len(data) - 6)
    for _ in range(index):
        name, extra, comment = struct.unpack_from("<HHH", data, at + 28)
        at += 46 + name + extra + comment
    return int(at)


def patched(data: bytes, at: int, replacement: bytes) -> bytes:
    """``data`` with some bytes replaced."""
    return data[:at] + replacement + data[at + len(replacement) :]


def text(value: str) -> bytes:
    """The opcode that pushes a string."""
    raw = value.encode()
    return b"X" + struct.pack("<I", len(raw)) + raw


def storage(key: str, count: int, kind: str = "FloatStorage", device: str = "cpu") -> bytes:
    """The opcodes that push a storage."""
    return b"(" + text("storage") + f"ctorch\n{kind}\n".encode() + text(key) + text(device) + integer(count) + b"tQ"


def integer(value: int) -> bytes:
    """The opcode that pushes an integer of up to 255 bytes."""
    width = max(9, value.bit_length() // 8 + 1)
    return b"\x8a" + bytes([width]) + value.to_bytes(width, "little", signed=True)


def numbers(values: tuple[int, ...]) -> bytes:
    """The opcodes that push a tuple of integers."""
    return b"(" + b"".join(map(integer, values)) + b"t"


def tensor(
    key: str, shape: tuple[int, ...], strides: tuple[int, ...], offset: int = 0, count: int | None = None, **named: str
) -> bytes:
    """The opcodes that push a tensor viewing storage ``key`` of ``count`` elements."""
    size = 1
    for extent in shape:
        size *= extent
    source = storage(key, size if count is None else count, **named)
    body = source + integer(offset) + numbers(shape) + numbers(strides) + b"\x89ccollections\nOrderedDict\n)R"
    return b"ctorch._utils\n_rebuild_tensor_v2\n(" + body + b"tR"


def assert_refused(action: Callable[[], object], reason: str) -> None:
    """The action raises FieldFormatError with this reason."""
    with pytest.raises(FieldFormatError) as caught:
        action()
    assert caught.value.reason == reason, str(caught.value)


def saved(folder: Path, data: bytes, name: str = "upload") -> Path:
    """``data`` in a file."""
    path = folder / name
    path.write_bytes(data)
    return path
