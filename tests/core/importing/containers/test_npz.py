""".npz files: the zip as strict as torch's, deflate without bombs, headers of plain numbers, no pickled objects."""

from __future__ import annotations

import io
import zipfile
import zlib
from typing import Any

import numpy as np
import pytest

from regnf_core.importing.containers import npz
from regnf_core.importing.containers.npz import ArraySource
from tests.core.importing.archives import assert_refused, central_header_at, patched, zip_bytes

NUMBERS = np.arange(6, dtype=np.float32).reshape(2, 3)
METHOD_AT, CRC_AT, PACKED_AT, SIZE_AT = 10, 16, 20, 24
"""Offsets within a central header."""
LOCAL_METHOD_AT, LOCAL_CRC_AT, LOCAL_SIZE_AT = 8, 14, 22


def npy(array: Any, **options: Any) -> bytes:
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.asarray(array), **options)
    return buffer.getvalue()


def npy_with(header: bytes, data: bytes = NUMBERS.tobytes(), version: bytes = b"\x01\x00") -> bytes:
    width = 2 if version == b"\x01\x00" else 4
    return b"\x93NUMPY" + version + len(header).to_bytes(width, "little") + header + data


def source(data: bytes, budget: int = 1 << 20) -> ArraySource:
    return ArraySource(memoryview(data), budget)


def read(entry: bytes, compression: int = zipfile.ZIP_STORED, budget: int = 1 << 20) -> Any:
    return source(zip_bytes([("a.npy", entry)], compression), budget).array("a")


def savez(compressed: bool = False, **arrays: Any) -> bytes:
    buffer = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(buffer, **arrays)
    return buffer.getvalue()


@pytest.mark.parametrize("compressed", [False, True])
def test_reads_what_numpy_saved(compressed: bool) -> None:
    rng = np.random.default_rng(0)
    real = {f"r{i}": rng.normal(size=(3, 4, 5)).astype(t) for i, t in enumerate(("f2", "f4", "f8"))}
    whole = {f"w{i}": np.arange(7).astype(t) for i, t in enumerate(("i1", "i2", "i4", "i8", "u1", "u2", "u4"))}
    arrays = source(savez(compressed, **real, **whole, order=np.asfortranarray(real["r2"]), few=np.float64(0.1)))
    assert set(arrays.names) == {*real, *whole, "order", "few"}
    for name, values in real.items():
        np.testing.assert_array_equal(arrays.array(name), values.astype(np.float32))
    for name, values in whole.items():
        np.testing.assert_array_equal(arrays.integers(name), values)
    np.testing.assert_array_equal(arrays.array("order"), real["r2"].astype(np.float32))
    assert float(arrays.numbers("few")) == 0.1


def test_reads_a_file_that_was_written_to_a_pipe() -> None:
    """Without going back, the sizes stand in descriptors behind the data."""

    class Pipe(io.RawIOBase):
        def __init__(self) -> None:
            self.data = bytearray()

        def writable(self) -> bool:
            return True

        def write(self, data: Any) -> int:
            self.data += data
            return len(data)

    pipe = Pipe()
    with zipfile.ZipFile(pipe, "w", zipfile.ZIP_DEFLATED) as archive:  # type: ignore[arg-type]
        archive.writestr("a.npy", npy(NUMBERS))
    np.testing.assert_array_equal(source(bytes(pipe.data)).array("a"), NUMBERS)


@pytest.mark.parametrize("version", [(1, 0), (2, 0), (3, 0)])
@pytest.mark.parametrize("array", [NUMBERS, np.float32(3.0), np.zeros(0, np.float32), np.zeros((0, 4), np.float32)])
@pytest.mark.filterwarnings("ignore:Stored array in format")
def test_every_version_and_shape_of_header(version: tuple[int, int], array: Any) -> None:
    np.testing.assert_array_equal(read(npy(array, version=version)), array)


def npy_of(descr: str = "'<f4'", shape: str = "(2, 3)", order: str = "False", more: str = "") -> bytes:
    """The six numbers behind a header of these words."""
    return npy_with(f"{{'descr': {descr}, 'fortran_order': {order}, 'shape': {shape}{more}}}".encode())


def test_headers_as_other_writers_spell_them() -> None:
    for shape, more in (("(2, 3)", ", "), ("(2,3)", "")):
        np.testing.assert_array_equal(read(npy_of(shape=shape, more=more)), NUMBERS)


@pytest.mark.parametrize(
    ("entry", "reason"),
    [
        *((raw, "NPY_MALFORMED") for raw in (b"", b"\x93NUMPY\x01\x00", b"\x93NUMPZ" + npy(NUMBERS)[6:])),
        (npy_with(b"{'descr': '<f4', 'fortran_order': False, 'shape': (2, 3)}", version=b"\x04\x00"), "NPY_MALFORMED"),
        (b"\x93NUMPY\x02\x00\xff\xff\xff\x7f" + bytes(64), "NPY_MALFORMED"),
        *(
            (npy_with(header), "NPY_MALFORMED")
            for header in (b" " * 5000, b"__import__('os').system('true')", b"(" * 4000, b"-" * 4000 + b"1", b"{[]: 1}")
        ),
        *(
            (npy_of(shape=shape), "NPY_MALFORMED")
            for shape in ("(-2, 3)", "(2, 3**9)", "(1,1,1,1,1,1,1,2,3)", "(2, True)")
        ),
        *((npy_of(more=", 'more': 1"), "NPY_MALFORMED"), (npy_of(order="0"), "NPY_MALFORMED")),
        (npy_of("[('x', '<f4')]", "(6,)"), "NPY_MALFORMED"),
        *((npy_of("'>f4'"), "TENSOR_DTYPE"), (npy_of("'<c8'", "(3,)"), "TENSOR_DTYPE")),
        *((npy_of("'|V24'", "(1,)"), "TENSOR_DTYPE"), (npy_of("'(2,)f4'", "(3,)"), "TENSOR_DTYPE")),
        *((npy_of(shape=shape), "TENSOR_STORAGE_MISMATCH") for shape in ("(2, 4)", "(2, 2)")),
        (npy_of(shape="(99999999, 99999999)"), "TENSOR_TOO_LARGE"),
        (npy_of(shape="(0, 999999999, 9999999999)"), "TENSOR_SHAPE"),
        (npy(np.array([{}, []], dtype=object), allow_pickle=True), "NPY_OBJECT_ARRAY"),
        *((npy_of("'O,f4'"), "NPY_OBJECT_ARRAY"), (npy(np.arange(6)), "TENSOR_DTYPE")),
        *((npy(np.array([number])), "TENSOR_NOT_FINITE") for number in (np.inf, 1e300)),
    ],
)
def test_faulty_arrays_are_refused(entry: bytes, reason: str) -> None:
    assert_refused(lambda: read(entry), reason)


def test_whole_numbers_are_no_real_ones_nor_the_other_way_round() -> None:
    arrays = source(savez(r=NUMBERS, w=np.arange(3), u=np.arange(3, dtype=np.uint64), b=np.array([True])))
    for name in ("w", "u", "b"):
        assert_refused(lambda name=name: arrays.array(name), "TENSOR_DTYPE")
    for name in ("r", "u", "b"):
        assert_refused(lambda name=name: arrays.integers(name), "TENSOR_DTYPE")
    assert_refused(lambda: arrays.numbers("b"), "TENSOR_DTYPE")
    assert_refused(lambda: source(savez(a=np.zeros(65))).numbers("a"), "TENSOR_SHAPE")  # a few are expected


def test_the_budget_counts_what_is_asked_for() -> None:
    data = savez(a=NUMBERS, b=NUMBERS)
    arrays = source(data, budget=40)
    arrays.array("a")
    assert_refused(lambda: arrays.array("b"), "TENSOR_TOO_LARGE")
    assert_refused(lambda: source(data).array("c"), "TENSOR_MISSING")


def test_a_bomb_is_refused_by_its_claim_before_it_is_inflated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(npz, "MAX_UNPACKED_BYTES", 1 << 16)

    def never(*_: object) -> None:
        raise AssertionError("inflated")

    monkeypatch.setattr(zlib, "decompressobj", never)
    assert_refused(lambda: read(npy(np.zeros(1 << 15)), zipfile.ZIP_DEFLATED), "TENSOR_TOO_LARGE")


@pytest.mark.parametrize("claimed", [100, 1 << 30])
def test_a_bomb_that_claims_another_size_is_found(claimed: int) -> None:
    data = zip_bytes([("a.npy", npy(np.zeros(1 << 15)))], zipfile.ZIP_DEFLATED)
    size = claimed.to_bytes(4, "little")
    lying = patched(patched(data, central_header_at(data, 0) + SIZE_AT, size), LOCAL_SIZE_AT, size)
    assert_refused(lambda: source(lying, 1 << 40).array("a"), "ARCHIVE_DEFLATE_MALFORMED")


def test_faulty_deflate_and_bytes_behind_its_end_are_found() -> None:
    content = npy(NUMBERS)
    for packed in (bytes(40), zlib.compress(content)[2:-4] + b"more", zlib.compress(content)[2:-8]):
        data = zip_bytes([("a.npy", packed)])
        at = central_header_at(data, 0)
        size, crc = len(content).to_bytes(4, "little"), zlib.crc32(content).to_bytes(4, "little")
        for place, value in ((METHOD_AT, b"\x08\x00"), (SIZE_AT, size), (CRC_AT, crc)):
            data = patched(data, at + place, value)
        for place, value in ((LOCAL_METHOD_AT, b"\x08\x00"), (LOCAL_SIZE_AT, size), (LOCAL_CRC_AT, crc)):
            data = patched(data, place, value)
        assert_refused(lambda data=data: source(data).array("a"), "ARCHIVE_DEFLATE_MALFORMED")


@pytest.mark.parametrize("compression", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_a_wrong_checksum_is_found(compression: int) -> None:
    data = zip_bytes([("a.npy", npy(NUMBERS))], compression)
    wrong = b"\1\2\3\4"
    data = patched(patched(data, central_header_at(data, 0) + CRC_AT, wrong), LOCAL_CRC_AT, wrong)
    assert_refused(lambda: source(data).array("a"), "ARCHIVE_CRC_MISMATCH")


@pytest.mark.parametrize(
    ("entries", "compression", "reason"),
    [
        ([("a.npy", npy(NUMBERS))], zipfile.ZIP_BZIP2, "ARCHIVE_COMPRESSED_ENTRY"),
        ([("a.npy", npy(NUMBERS))], zipfile.ZIP_LZMA, "ARCHIVE_COMPRESSED_ENTRY"),
        ([("a.npy", npy(NUMBERS)), ("readme.txt", b"x")], zipfile.ZIP_STORED, "ARCHIVE_ENTRY_NAME"),
        ([("a.npy", npy(NUMBERS)), ("b/c.npy", npy(NUMBERS))], zipfile.ZIP_STORED, "ARCHIVE_ENTRY_NAME"),
        ([("../a.npy", npy(NUMBERS))], zipfile.ZIP_STORED, "ARCHIVE_ENTRY_NAME"),
    ],
)
def test_other_archives_are_refused(entries: list[tuple[str, bytes]], compression: int, reason: str) -> None:
    assert_refused(lambda: source(zip_bytes(entries, compression)), reason)


def test_the_container_is_as_strict_as_torchs() -> None:
    data = savez(a=NUMBERS)
    assert_refused(lambda: source(data + b"x"), "ARCHIVE_TRAILING_DATA")
    assert_refused(lambda: source(b"x" + data), "ARCHIVE_PREFIXED_DATA")
    for end in range(1, len(data), 17):
        assert_refused(lambda end=end: source(data[:end]), "FILE_TRUNCATED")
    assert_refused(lambda: source(patched(data, 6, b"\x01\x00")), "ARCHIVE_HEADER_MISMATCH")
