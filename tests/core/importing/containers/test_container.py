from __future__ import annotations

import io
import struct
import zipfile
from pathlib import Path

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


def read(data: bytes) -> TorchArchive:
    return read_archive(memoryview(data))


def assert_rejected(data: bytes, reason: str) -> None:
    assert_refused(lambda: read(data), reason)


@pytest.fixture
def saved_by_torch(tmp_path: Path) -> bytes:
    path = tmp_path / "weights.pt"
    torch.save({"a": torch.arange(5.0), "empty": torch.zeros(0), "b": torch.ones(3, dtype=torch.float64)}, path)
    return path.read_bytes()


def test_lists_what_torch_saved_where_it_lies(saved_by_torch: bytes) -> None:
    archive = read(saved_by_torch)
    assert archive.entries["data/0"].size == 20
    assert bytes(archive.read("data/0")) == struct.pack("<5f", 0, 1, 2, 3, 4)
    assert archive.entries["data/1"].size == 0


def test_reads_an_archive_without_descriptors() -> None:
    assert bytes(read(torch_zip(storages={"0": b"abcd"})).read("data/0")) == b"abcd"


def test_every_truncation_is_refused(saved_by_torch: bytes) -> None:
    length = len(saved_by_torch)
    for end in {*range(1, length, 37), *range(length - 120, length)}:
        assert_rejected(saved_by_torch[:end], "FILE_TRUNCATED")


def test_a_flipped_bit_in_a_storage_is_found_when_it_is_read(saved_by_torch: bytes) -> None:
    at = read(saved_by_torch).entries["data/0"].offset
    damaged = read(patched(saved_by_torch, at + 3, bytes([saved_by_torch[at + 3] ^ 1])))
    assert_refused(lambda: damaged.read("data/0"), "ARCHIVE_CRC_MISMATCH")


def test_compressed_entries_are_refused_before_anything_is_inflated() -> None:
    entries = [("archive/data.pkl", PICKLE_OF_NOTHING), ("archive/data/0", bytes(1 << 20))]
    assert_rejected(zip_bytes(entries, zipfile.ZIP_DEFLATED), "ARCHIVE_COMPRESSED_ENTRY")


def test_compression_claimed_by_the_central_directory_alone_is_refused() -> None:
    data = torch_zip()
    assert_rejected(patched(data, central_header_at(data, 1) + METHOD_AT, b"\x08\x00"), "ARCHIVE_COMPRESSED_ENTRY")


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_two_entries_of_one_name_are_refused() -> None:
    entries = [("archive/data.pkl", PICKLE_OF_NOTHING), ("archive/data.pkl", b"\x80\x02N.")]
    assert_rejected(zip_bytes(entries), "ARCHIVE_DUPLICATE_ENTRY")


def test_a_second_data_pkl_further_down_is_refused() -> None:
    entries = [("archive/data.pkl", PICKLE_OF_NOTHING), ("archive/x/data.pkl", PICKLE_OF_NOTHING)]
    assert_rejected(zip_bytes(entries), "ARCHIVE_DUPLICATE_ENTRY")


UNSAFE_NAMES = [
    "archive/../evil",
    "/archive/data/0",
    "archive/a\\b",
    "archive/data/",
    "archive//0",
    "loose",
    "other/data/0",
]


@pytest.mark.parametrize("name", UNSAFE_NAMES)
def test_names_that_leave_the_folder_are_refused(name: str) -> None:
    assert_rejected(zip_bytes([("archive/data.pkl", PICKLE_OF_NOTHING), (name, b"")]), "ARCHIVE_ENTRY_NAME")


def test_a_name_with_a_nul_is_refused() -> None:
    data = torch_zip(storages={"0": b"abcd"}).replace(b"archive/data/0", b"archive/data\0\x30")
    assert_rejected(data, "ARCHIVE_ENTRY_NAME")


@pytest.mark.parametrize("flag", [0x0001, 0x0040, 0x2000])
def test_encrypted_entries_are_refused(flag: int) -> None:
    data = torch_zip()
    assert_rejected(patched(data, central_header_at(data, 0) + FLAGS_AT, struct.pack("<H", flag)), "ARCHIVE_ENCRYPTED")


@pytest.mark.parametrize(("at", "value"), [(14, b"\x01\x02\x03\x04"), (22, b"\x01\x00\x00\x00"), (30, b"b")])
def test_a_local_header_that_contradicts_the_directory_is_refused(at: int, value: bytes) -> None:
    assert_rejected(patched(torch_zip(), at, value), "ARCHIVE_HEADER_MISMATCH")


def test_a_descriptor_that_contradicts_the_directory_is_refused(saved_by_torch: bytes) -> None:
    entry = read(saved_by_torch).entries["data/0"]
    assert_rejected(patched(saved_by_torch, entry.offset + entry.size + 8, b"\x15"), "ARCHIVE_HEADER_MISMATCH")


def test_entries_over_one_another_are_refused() -> None:
    data = torch_zip(storages={"0": b"abcd"})
    (first,) = struct.unpack_from("<I", data, central_header_at(data, 1) + LOCAL_OFFSET_AT)
    assert_rejected(
        patched(data, central_header_at(data, 2) + LOCAL_OFFSET_AT, struct.pack("<I", first)), "ARCHIVE_OVERLAP"
    )


def test_sizes_beyond_the_file_are_refused() -> None:
    data = torch_zip(storages={"0": b"abcd"})
    huge = struct.pack("<II", 1 << 31, 1 << 31)
    assert_rejected(patched(data, central_header_at(data, 2) + SIZE_AT - 4, huge), "ARCHIVE_ENTRY_OUT_OF_BOUNDS")


def test_zip64_sizes_of_2_to_the_63_are_refused() -> None:
    data = torch_zip()
    at = central_header_at(data, 0)
    name = data[at + 46 : at + 46 + 16]
    extra = struct.pack("<HHQQ", 1, 16, 1 << 63, 1 << 63)
    header = bytearray(data[at : at + 46])
    header[SIZE_AT - 4 : SIZE_AT + 4] = b"\xff" * 8
    header[30:32] = struct.pack("<H", len(extra))
    rest = data[at + 46 + 16 : -22]
    size = 46 + 16 + len(extra) + len(rest)
    end = patched(data[-22:], 12, struct.pack("<I", size))
    assert_rejected(data[:at] + bytes(header) + name + extra + rest + end, "ARCHIVE_ENTRY_OUT_OF_BOUNDS")


def test_a_zip64_size_that_is_missing_is_refused() -> None:
    data = torch_zip()
    assert_rejected(patched(data, central_header_at(data, 0) + SIZE_AT, b"\xff" * 4), "ARCHIVE_MALFORMED")


def test_extra_fields_without_end_are_refused() -> None:
    entry = zipfile.ZipInfo("archive/data.pkl")
    entry.extra = struct.pack("<HH", 0x4246, 0) * 1000
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr(entry, PICKLE_OF_NOTHING)
    assert_rejected(buffer.getvalue(), "ARCHIVE_MALFORMED")


def test_bytes_before_behind_and_between_are_refused() -> None:
    data = torch_zip()
    assert_rejected(b"MZ" + data, "ARCHIVE_PREFIXED_DATA")
    assert_rejected(data + b"\0" * 64, "ARCHIVE_TRAILING_DATA")
    assert_rejected(patched(data, len(data) - 2, b"\x04\x00") + b"note", "ARCHIVE_TRAILING_DATA")
    at = central_header_at(data, 0)
    assert_rejected(
        data[:at] + b"hidden" + patched(data[at:], len(data) - at - 6, struct.pack("<I", at + 6)), "ARCHIVE_HIDDEN_DATA"
    )


def test_an_archive_before_the_archive_is_refused() -> None:
    first, second = torch_zip(), torch_zip(storages={"0": b"abcd"})
    assert_rejected(first + second, "ARCHIVE_MALFORMED")


def test_too_many_entries_are_refused_before_they_are_read() -> None:
    data = torch_zip()
    count = struct.pack("<HH", MAX_ENTRIES + 1, MAX_ENTRIES + 1)
    assert_rejected(patched(data, len(data) - 14, count), "ARCHIVE_TOO_MANY_ENTRIES")


def test_a_count_that_hides_entries_is_refused() -> None:
    data = torch_zip()
    assert_rejected(patched(data, len(data) - 14, struct.pack("<HH", 2, 2)), "ARCHIVE_MALFORMED")


def test_a_part_of_a_split_archive_is_refused() -> None:
    data = torch_zip()
    assert_rejected(patched(data, len(data) - 18, b"\x01\x00"), "ARCHIVE_MULTI_DISK")


def test_other_contents_are_named() -> None:
    assert_rejected(zip_bytes([("archive/version", b"3\n")]), "ARCHIVE_NO_PICKLE")
    program = [("archive/data.pkl", PICKLE_OF_NOTHING), ("archive/code/__torch__.py", b"")]
    assert_rejected(zip_bytes(program), "ARCHIVE_TORCHSCRIPT")
    big_endian = [("archive/data.pkl", PICKLE_OF_NOTHING), ("archive/byteorder", b"big")]
    assert_rejected(zip_bytes(big_endian), "ARCHIVE_BYTE_ORDER")


def test_a_large_pickle_is_refused() -> None:
    data = memoryview(torch_zip(bytes(1000)))
    assert_refused(lambda: read_archive(data, max_pickle_bytes=999), "PICKLE_TOO_LARGE")
