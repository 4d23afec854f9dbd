"""torch.save's zip container: what torch wrote is read where it lies, and every lie of its layout is refused."""

from __future__ import annotations

import io
import struct
import zipfile
from collections.abc import Callable

import pytest
import torch

from regnf_core.importing.containers.legacy_container import TorchArchive, read_archive
from regnf_core.importing.containers.zip_members import MAX_ENTRIES
from tests.core.importing.archives import (
    PICKLE_OF_NOTHING,
    assert_refused,
    central_header_at,
    patched,
    torch_zip,
    zip_bytes,
)

FLAGS_AT, METHOD_AT, CRC_AT, SIZE_AT, LOCAL_OFFSET_AT = 8, 10, 16, 24, 42
"""Offsets within a central header."""
PICKLE = ("archive/data.pkl", PICKLE_OF_NOTHING)
PLAIN, STORING = torch_zip(), torch_zip(storages={"0": b"abcd"})


def read(data: bytes) -> TorchArchive:
    return read_archive(memoryview(data))


def saved() -> bytes:
    buffer = io.BytesIO()
    torch.save({"a": torch.arange(5.0), "empty": torch.zeros(0), "b": torch.ones(3, dtype=torch.float64)}, buffer)
    return buffer.getvalue()


SAVED = saved()


def test_lists_what_was_saved_where_it_lies() -> None:
    archive = read(SAVED)
    assert archive.entries["data/0"].size == 20
    assert bytes(archive.read("data/0")) == struct.pack("<5f", 0, 1, 2, 3, 4)
    assert archive.entries["data/1"].size == 0
    assert bytes(read(STORING).read("data/0")) == b"abcd"  # without descriptors


def test_every_truncation_is_refused() -> None:
    length = len(SAVED)
    for end in {*range(1, length, 37), *range(length - 120, length)}:
        assert_refused(lambda end=end: read(SAVED[:end]), "FILE_TRUNCATED")


def test_a_flipped_bit_in_a_storage_is_found_when_it_is_read() -> None:
    at = read(SAVED).entries["data/0"].offset
    damaged = read(patched(SAVED, at + 3, bytes([SAVED[at + 3] ^ 1])))
    assert_refused(lambda: damaged.read("data/0"), "ARCHIVE_CRC_MISMATCH")


def central(field: int, value: bytes, entry: int = 0, data: bytes = PLAIN) -> bytes:
    """With another value in an entry's central header."""
    return patched(data, central_header_at(data, entry) + field, value)


def ended(from_end: int, value: bytes) -> bytes:
    """With another value in the record at the end."""
    return patched(PLAIN, len(PLAIN) - from_end, value)


def wide_sizes() -> bytes:
    """Sizes of 2^63 in a zip64 field."""
    at = central_header_at(PLAIN, 0)
    extra = struct.pack("<HHQQ", 1, 16, 1 << 63, 1 << 63)
    header = bytearray(PLAIN[at : at + 46])
    header[SIZE_AT - 4 : SIZE_AT + 4] = b"\xff" * 8
    header[30:32] = struct.pack("<H", len(extra))
    name, rest = PLAIN[at + 46 : at + 62], PLAIN[at + 62 : -22]
    end = patched(PLAIN[-22:], 12, struct.pack("<I", 62 + len(extra) + len(rest)))
    return PLAIN[:at] + bytes(header) + name + extra + rest + end


def endless_extra() -> bytes:
    entry, buffer = zipfile.ZipInfo("archive/data.pkl"), io.BytesIO()
    entry.extra = struct.pack("<HH", 0x4246, 0) * 1000
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr(entry, PICKLE_OF_NOTHING)
    return buffer.getvalue()


def over_one_another() -> bytes:
    (first,) = struct.unpack_from("<I", STORING, central_header_at(STORING, 1) + LOCAL_OFFSET_AT)
    return central(LOCAL_OFFSET_AT, struct.pack("<I", first), 2, STORING)


def between() -> bytes:
    at = central_header_at(PLAIN, 0)
    return PLAIN[:at] + b"hidden" + patched(PLAIN[at:], len(PLAIN) - at - 6, struct.pack("<I", at + 6))


def descriptor() -> bytes:
    entry = read(SAVED).entries["data/0"]
    return patched(SAVED, entry.offset + entry.size + 8, b"\x15")


BAD: list[tuple[Callable[[], bytes], str]] = [
    (lambda: zip_bytes([PICKLE, ("archive/data/0", bytes(1 << 20))], zipfile.ZIP_DEFLATED), "COMPRESSED_ENTRY"),
    (lambda: central(METHOD_AT, b"\x08\x00", 1), "COMPRESSED_ENTRY"),  # claimed by the directory alone
    (lambda: zip_bytes([PICKLE, ("archive/data.pkl", b"\x80\x02N.")]), "DUPLICATE_ENTRY"),
    (lambda: zip_bytes([PICKLE, ("archive/x/data.pkl", PICKLE_OF_NOTHING)]), "DUPLICATE_ENTRY"),
    *(
        (lambda name=name: zip_bytes([PICKLE, (name, b"")]), "ENTRY_NAME")  # type: ignore[misc]
        for name in ("archive/../evil", "/archive/data/0", "archive/a\\b", "archive/data/", "archive//0", "loose")
    ),
    (lambda: zip_bytes([PICKLE, ("other/data/0", b"")]), "ENTRY_NAME"),
    (lambda: STORING.replace(b"archive/data/0", b"archive/data\0\x30"), "ENTRY_NAME"),
    (lambda: central(FLAGS_AT, b"\x01\x00"), "ENCRYPTED"),
    (lambda: central(FLAGS_AT, b"\x40\x00"), "ENCRYPTED"),
    (lambda: central(FLAGS_AT, b"\x00\x20"), "ENCRYPTED"),
    (lambda: patched(PLAIN, 14, b"\x01\x02\x03\x04"), "HEADER_MISMATCH"),
    (lambda: patched(PLAIN, 22, b"\x01\x00\x00\x00"), "HEADER_MISMATCH"),
    (lambda: patched(PLAIN, 30, b"b"), "HEADER_MISMATCH"),
    (descriptor, "HEADER_MISMATCH"),
    (over_one_another, "OVERLAP"),
    (lambda: central(SIZE_AT - 4, struct.pack("<II", 1 << 31, 1 << 31), 2, STORING), "ENTRY_OUT_OF_BOUNDS"),
    (wide_sizes, "ENTRY_OUT_OF_BOUNDS"),
    (lambda: central(SIZE_AT, b"\xff" * 4), "MALFORMED"),  # and no zip64 field
    (endless_extra, "MALFORMED"),
    (lambda: PLAIN + STORING, "MALFORMED"),
    (lambda: b"MZ" + PLAIN, "PREFIXED_DATA"),
    (lambda: PLAIN + b"\0" * 64, "TRAILING_DATA"),
    (lambda: ended(2, b"\x04\x00") + b"note", "TRAILING_DATA"),
    (between, "HIDDEN_DATA"),
    (lambda: ended(14, struct.pack("<HH", MAX_ENTRIES + 1, MAX_ENTRIES + 1)), "TOO_MANY_ENTRIES"),
    (lambda: ended(14, struct.pack("<HH", 2, 2)), "MALFORMED"),  # a count that hides entries
    (lambda: ended(18, b"\x01\x00"), "MULTI_DISK"),
    (lambda: zip_bytes([("archive/version", b"3\n")]), "NO_PICKLE"),
    (lambda: zip_bytes([PICKLE, ("archive/code/__torch__.py", b"")]), "TORCHSCRIPT"),
    (lambda: zip_bytes([PICKLE, ("archive/byteorder", b"big")]), "BYTE_ORDER"),
]


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize(("make", "reason"), BAD)
def test_what_lies_is_refused(make: Callable[[], bytes], reason: str) -> None:
    assert_refused(lambda: read(make()), f"ARCHIVE_{reason}")


def test_a_large_pickle_is_refused() -> None:
    data = memoryview(torch_zip(bytes(1000)))
    assert_refused(lambda: read_archive(data, max_pickle_bytes=999), "PICKLE_TOO_LARGE")
