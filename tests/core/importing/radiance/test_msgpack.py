"""MessagePack against its common library; and files that are damaged, or larger than they look."""

from __future__ import annotations

import gzip
from typing import Any

import msgpack
import pytest

from regnf_core.errors import FieldFormatError
from regnf_core.importing.snapshots.msgpack import read_msgpack, unpacked

NUMBERS = [
    0,
    1,
    127,
    128,
    255,
    256,
    65535,
    65536,
    2**32 - 1,
    2**32,
    2**64 - 1,
    -1,
    -32,
    -33,
    -128,
    -129,
    -(2**31),
    -(2**63),
]
VALUES: dict[str, Any] = {
    "numbers": NUMBERS,
    "reals": [0.5, -1e300, 3.25],
    "words": [None, True, False],
    "texts": ["", "a", "ü" * 20, "b" * 300, "c" * 70_000],
    "lists": [[], [1] * 15, [2] * 16, [3] * 70_000],
    "maps": [{}, {str(i): i for i in range(15)}, {str(i): [i] for i in range(16)}, {str(i): i for i in range(70_000)}],
    "bytes": [b"", b"x" * 10, b"y" * 300, b"z" * 70_000],
}


def test_what_the_library_writes_is_read() -> None:
    assert read_msgpack(memoryview(msgpack.packb(VALUES))) == VALUES
    single = msgpack.packb([0.5, 3.25], use_single_float=True)
    assert read_msgpack(memoryview(single)) == [0.5, 3.25]


def test_every_truncation_is_told() -> None:
    packed = msgpack.packb({"a": [1, 2.5, "text", b"bytes", {"b": None}], "c": -40_000})
    for size in range(len(packed)):
        with pytest.raises(FieldFormatError) as caught:
            read_msgpack(memoryview(packed[:size]))
        assert caught.value.reason == "FILE_TRUNCATED", str(caught.value)


@pytest.mark.parametrize(
    "data",
    [
        b"\xc1",
        b"\x01\x02",
        b"\xa1\xff",
        b"\x81\x01\x02",
        b"\x82\xa1a\x01\xa1a\x02",
        b"\x91" * 5000 + b"\x01",
        b"\xdd\x00\x20\x00\x00" + b"\x01" * 0x200000,
        b"\xdc\x02\x00" + (b"\xdc\x10\x00" + b"\xc0" * 0x1000) * 0x200,
    ],
    ids=["no value", "more data", "no text", "key", "twice", "deep", "long", "many"],
)
def test_malformed_files_are_refused(data: bytes) -> None:
    with pytest.raises(FieldFormatError, match="MessagePack") as caught:
        read_msgpack(memoryview(data))
    assert caught.value.reason == "FORMAT_NOT_SUPPORTED"


def test_a_claimed_length_allocates_nothing() -> None:
    for head in (b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff"):
        with pytest.raises(FieldFormatError, match=r"MessagePack|ends within"):
            read_msgpack(memoryview(head))


def test_packed_files() -> None:
    packed = gzip.compress(msgpack.packb(VALUES))
    assert read_msgpack(unpacked(memoryview(packed), 1 << 30)) == VALUES
    plain_file = memoryview(b"\x01")
    assert unpacked(plain_file, 1 << 30) is plain_file
    for damaged, reason in (
        (packed[:-10], "FILE_TRUNCATED"),
        (packed[:50] + b"\xff" * 50 + packed[100:], "FORMAT_NOT_SUPPORTED"),
        (gzip.compress(bytes(65 << 20)), "ARCHIVE_TOO_LARGE"),
    ):
        with pytest.raises(FieldFormatError) as caught:
            unpacked(memoryview(damaged), 1 << 30)
        assert caught.value.reason == reason
