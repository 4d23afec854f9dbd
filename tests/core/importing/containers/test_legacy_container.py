"""The container of before PyTorch 1.6: read like the other one, and every lie of its layout refused."""

from __future__ import annotations

import io
import pickle
import struct
from collections import OrderedDict
from typing import Any

import numpy as np
import pytest
import torch

from regnf_core.errors import FieldFormatError
from regnf_core.importing.containers.legacy_container import TorchArchive, read_legacy
from regnf_core.importing.pickle.pickle_machine import Placeholder, TensorRef
from regnf_core.importing.tensor_source import TensorSource
from tests.core.importing.archives import assert_refused, integer, numbers, text

MAGIC = pickle.dumps(0x1950A86A20F9469CFC6C, 2)
VERSION = pickle.dumps(1001, 2)
MACHINE = pickle.dumps({"protocol_version": 1001, "little_endian": True, "type_sizes": {"int": 4}}, 2)


def saved(values: object) -> bytes:
    buffer = io.BytesIO()
    torch.save(values, buffer, _use_new_zipfile_serialization=False)
    return buffer.getvalue()


def read(data: bytes) -> tuple[Any, TorchArchive]:
    return read_legacy(memoryview(data))


def legacy(values: bytes, keys: object, storages: bytes = b"", machine: bytes = MACHINE) -> bytes:
    """A file with any pickle of values, any list of keys and any bytes behind."""
    return MAGIC + VERSION + machine + values + pickle.dumps(keys, 2) + storages


def vector(key: str = "7", count: int = 2, kind: str = "FloatStorage", view: bytes = b"N") -> bytes:
    """The pickle of a tensor (count,)."""
    source = b"(" + text("storage") + f"ctorch\n{kind}\n".encode() + text(key) + text("cpu") + integer(count) + view
    body = source + b"tQ" + integer(0) + numbers((count,)) + numbers((1,)) + b"\x89ccollections\nOrderedDict\n)R"
    return b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n(" + body + b"tR."


def floats(*values: float, count: int | None = None) -> bytes:
    """A stored storage of floats."""
    return struct.pack("<q", len(values) if count is None else count) + struct.pack(f"<{len(values)}f", *values)


def test_all_tensors_are_read_whatever_their_types_and_order() -> None:
    values = OrderedDict(
        weight=torch.randn(3, 5),
        count=torch.tensor(7),
        mask=torch.ones(3, dtype=torch.bool),
        half=torch.randn(4).half(),
        transposed=torch.randn(4, 2).T,
        brain=torch.randn(3).bfloat16(),
        epoch=12,
    )
    found, archive = read(saved(values))
    source = TensorSource(archive, 1 << 20)
    assert found["epoch"] == 12
    for name in ("weight", "half", "transposed", "brain"):
        np.testing.assert_array_equal(source.array(name, found[name]), values[name].float().numpy())
    assert_refused(lambda: source.array("count", found["count"]), "TENSOR_DTYPE")


def test_a_storage_may_begin_at_any_byte() -> None:
    found, archive = read(legacy(vector(), ["7"], floats(0.25, -4.0)))
    assert isinstance(found, TensorRef)
    np.testing.assert_array_equal(TensorSource(archive, 100).array("v", found), [0.25, -4.0])


def test_nothing_is_imported() -> None:
    found, _ = read(legacy(b"\x80\x02cos\nsystem\n" + text("false") + b"\x85R.", []))
    assert isinstance(found, Placeholder)
    assert found.full_name == "os.system"


def test_a_file_cut_anywhere_is_refused() -> None:
    whole = saved({"weight": torch.randn(3)})
    for end in range(len(whole)):
        with pytest.raises(FieldFormatError) as caught:
            read(whole[:end])
        assert caught.value.reason in ("FILE_TRUNCATED", "PICKLE_MALFORMED", "PICKLE_PROTOCOL")


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "FILE_TRUNCATED"),
        (MAGIC + VERSION, "FILE_TRUNCATED"),
        (VERSION + VERSION + MACHINE + vector() + pickle.dumps([], 2), "LEGACY_MALFORMED"),
        (MAGIC + MAGIC + MACHINE + vector() + pickle.dumps([], 2), "LEGACY_MALFORMED"),
        (legacy(vector(), [], machine=pickle.dumps([1], 2)), "LEGACY_MALFORMED"),
        (legacy(vector(), [], machine=pickle.dumps({"little_endian": False}, 2)), "ARCHIVE_BYTE_ORDER"),
        (legacy(vector(), [], machine=pickle.dumps({"little_endian": 1}, 2)), "ARCHIVE_BYTE_ORDER"),
        (legacy(vector(), {}), "LEGACY_MALFORMED"),
        (legacy(vector(), [7]), "LEGACY_MALFORMED"),
        (legacy(vector(), ["7", "7"], 2 * floats(1.0, 2.0)), "LEGACY_MALFORMED"),
        (legacy(vector(), ["8"], floats(1.0, 2.0)), "TENSOR_STORAGE_MISSING"),
        (legacy(vector(), ["7"], floats(1.0)), "FILE_TRUNCATED"),
        (legacy(vector(), ["7"], floats(1.0, 2.0, count=1)), "TENSOR_STORAGE_MISMATCH"),
        (legacy(vector(), ["7"], floats(1.0, 2.0, count=-2)), "TENSOR_STORAGE_MISMATCH"),
        (legacy(vector(), ["7"], floats(1.0, 2.0) + b"\0"), "ARCHIVE_TRAILING_DATA"),
        (legacy(vector(), [], floats(1.0, 2.0)), "ARCHIVE_TRAILING_DATA"),
        (legacy(vector(count=1 << 40), ["7"], floats(1.0, 2.0)), "FILE_TRUNCATED"),
        (legacy(vector(kind="QInt8Storage"), ["7"], floats(1.0, 2.0)), "TENSOR_DTYPE"),
        (legacy(vector(view=b"(" + text("8") + integer(0) + integer(2) + b"t"), ["7"]), "PICKLE_MALFORMED"),
        (legacy(vector(), [str(i) for i in range(20_000)]), "ARCHIVE_TOO_MANY_ENTRIES"),
        (legacy(vector(), [str(i) for i in range(70_000)]), "PICKLE_TOO_COMPLEX"),
        (legacy(vector()[:-1], []), "PICKLE_OPCODE_NOT_ALLOWED"),
        (legacy(b"\x80\x02\x8aoops.", []), "PICKLE_INTEGER_TOO_LARGE"),
    ],
)
def test_faulty_files_are_refused(data: bytes, reason: str) -> None:
    assert_refused(lambda: read(data), reason)


def test_a_tensor_whose_storage_was_left_out() -> None:
    found, archive = read(legacy(vector(), []))
    assert_refused(lambda: TensorSource(archive, 100).array("v", found), "TENSOR_STORAGE_MISSING")
