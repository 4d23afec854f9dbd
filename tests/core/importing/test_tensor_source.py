from __future__ import annotations

import io
import struct
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import require_shape
from regnf_core.importing.containers.legacy_container import read_archive
from regnf_core.importing.pickle.pickle_reader import read_pickle
from regnf_core.importing.tensor_source import TensorSource
from tests.core.importing.archives import assert_refused, patched, tensor, torch_zip, zip_bytes

SIX = struct.pack("<6f", *range(6))


def materialize(data: bytes, budget: int = 1 << 20) -> Any:
    """The single tensor that is an archive's whole value."""
    archive = read_archive(memoryview(data))
    return TensorSource(archive, budget).array("w", read_pickle(archive.read("data.pkl")))


def made_by_hand(body: bytes, **storages: bytes) -> bytes:
    return torch_zip(b"\x80\x02" + body + b".", {key[1:]: value for key, value in storages.items()})


def saved(value: object) -> bytes:
    buffer = io.BytesIO()
    torch.save(value, buffer)
    return buffer.getvalue()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.float16, torch.bfloat16])
def test_values_come_back_as_float32(dtype: torch.dtype) -> None:
    original = torch.linspace(-3, 3, 24).reshape(2, 3, 4).to(dtype)
    array = materialize(saved(original))
    assert array.dtype == np.float32
    np.testing.assert_array_equal(array, original.float().numpy())


@pytest.mark.parametrize(
    "original",
    [torch.arange(24.0).reshape(2, 3, 4).permute(axes) for axes in ((1, 0, 2), (2, 1, 0), (2, 0, 1))]
    + [torch.ones(shape) for shape in ((), (1,), (0,), (0, 3), (3, 0), (5, 1), (1, 5), (1, 1, 1))],
)
def test_axes_in_another_order_and_small_and_empty_shapes(original: torch.Tensor) -> None:
    np.testing.assert_array_equal(materialize(saved(original)), original.numpy())


def test_float32_is_not_copied() -> None:
    data = bytearray(saved(torch.arange(6.0).reshape(2, 3)))
    archive = read_archive(memoryview(data))
    array = TensorSource(archive, 1 << 20).array("w", read_pickle(archive.read("data.pkl")))
    data[archive.entries["data/0"].offset : archive.entries["data/0"].offset + 4] = struct.pack("<f", 77.0)
    assert array[0, 0] == 77.0


@pytest.mark.parametrize("shift", range(1, 18, 4))
def test_tensors_at_odd_places_are_moved_where_wide_loads_may_read_them(shift: int) -> None:
    """torch crashes over a table of rows of four floats that is not aligned by 16 bytes."""
    name = ("x" * shift, b"")
    pickle = b"\x80\x02" + tensor("0", (1, 4), (4, 1)) + b"."
    entries = [(f"archive/{part}", data) for part, data in (name, ("data.pkl", pickle), ("data/0", bytes(16)))]
    assert materialize(zip_bytes(entries)).ctypes.data % 16 == 0


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        (tensor("0", (2, 2), (2, 1)), "TENSOR_STORAGE_MISMATCH"),  # a view of less than the storage
        (tensor("0", (2, 3), (3, 1), count=12), "TENSOR_STORAGE_MISMATCH"),  # a lie about the count
        (tensor("0", (2, 3), (3, 1), offset=1), "TENSOR_STORAGE_MISMATCH"),
        (tensor("0", (12,), (1,)), "TENSOR_STORAGE_MISMATCH"),  # more than the entry holds
        (tensor("0", (10**6, 10**6), (0, 0), count=6), "TENSOR_TOO_LARGE"),
        (tensor("0", (2, 3), (0, 0)), "TENSOR_NOT_DENSE"),
        (tensor("0", (2, 3), (3, 2)), "TENSOR_NOT_DENSE"),
        (tensor("0", (2, 3), (10**12, 1)), "TENSOR_NOT_DENSE"),
        (tensor("1", (2, 3), (3, 1)), "TENSOR_STORAGE_MISSING"),
        (tensor("0", (2, 3), (3, 1), kind="IntStorage"), "TENSOR_DTYPE"),
        (tensor("0", (2, 3), (3, 1), kind="BoolStorage"), "TENSOR_DTYPE"),
        (tensor("0", (3,), (1,), kind="ComplexFloatStorage"), "TENSOR_DTYPE"),
        (tensor("0", (6,), (1,), kind="QInt8Storage"), "TENSOR_DTYPE"),
        (tensor("0", (6,), (1,), device="meta"), "TENSOR_DEVICE"),
        (b"]K\x01a", "TENSOR_EXPECTED"),
        (b"G\x3f\xf0\x00\x00\x00\x00\x00\x00", "TENSOR_EXPECTED"),
        (b"ctorch._utils\n_rebuild_sparse_tensor\n)R", "UNSAFE_GLOBAL_IN_WEIGHTS"),
        (b"ctorch._utils\n_rebuild_qtensor\n)R", "UNSAFE_GLOBAL_IN_WEIGHTS"),
        (b"ctorch._utils\n_rebuild_wrapper_subclass\n)R", "UNSAFE_GLOBAL_IN_WEIGHTS"),
        (b"ctorch._tensor\n_rebuild_from_type_v2\n)R", "UNSAFE_GLOBAL_IN_WEIGHTS"),
        (b"ctorch.storage\n_load_from_bytes\n)R", "UNSAFE_GLOBAL_IN_WEIGHTS"),
        (b"ctorch\nfloat32\n", "UNSAFE_GLOBAL_IN_WEIGHTS"),
    ],
)
def test_tensors_that_lie_are_refused(body: bytes, reason: str) -> None:
    assert_refused(lambda: materialize(made_by_hand(body, s0=SIX)), reason)


@pytest.mark.parametrize("shape", [(0, 1 << 47, 1 << 47), (1 << 47, 0, 1 << 47), (0, *[1 << 47] * 15)])
def test_an_empty_tensor_too_wide_for_any_array_is_refused(shape: tuple[int, ...]) -> None:
    for strides in (shape, (1,) * len(shape)):
        assert_refused(partial(materialize, made_by_hand(tensor("0", shape, strides), s0=b"")), "TENSOR_SHAPE")


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        (torch.eye(3).to_sparse(), "UNSAFE_GLOBAL_IN_WEIGHTS"),
        (torch.empty(3, device="meta"), "UNSAFE_GLOBAL_IN_WEIGHTS"),
        (torch.ones(4, 4)[:, :2], "TENSOR_STORAGE_MISMATCH"),
        (torch.ones(3, 1).expand(3, 4), "TENSOR_STORAGE_MISMATCH"),
        (torch.tensor([1e300], dtype=torch.float64), "TENSOR_NOT_FINITE"),  # too large for float32
        *(
            (torch.tensor([1.0, value, 2.0], dtype=dtype), "TENSOR_NOT_FINITE")
            for value in (float("nan"), float("inf"), float("-inf"))
            for dtype in (torch.float32, torch.float64, torch.float16, torch.bfloat16)
        ),
    ],
)
def test_real_odd_tensors_are_refused(value: torch.Tensor, reason: str) -> None:
    assert_refused(lambda: materialize(saved(value)), reason)


def test_the_refusal_names_the_global() -> None:
    with pytest.raises(FieldFormatError, match=r"evil\.loader"):
        materialize(made_by_hand(b"cevil\nloader\n)R"))


def test_damaged_storages_are_refused_and_undamaged_neighbors_are_not() -> None:
    data = made_by_hand(tensor("0", (6,), (1,)), s0=SIX, s1=SIX)
    archive = read_archive(memoryview(data))
    other = archive.entries["data/1"].offset
    materialize(patched(data, other, b"\xff"))
    mine = archive.entries["data/0"].offset
    assert_refused(lambda: materialize(patched(data, mine, b"\xff")), "ARCHIVE_CRC_MISMATCH")


def test_all_tensors_share_one_budget() -> None:
    archive = read_archive(memoryview(made_by_hand(tensor("0", (6,), (1,)), s0=SIX)))
    ref = read_pickle(archive.read("data.pkl"))
    source = TensorSource(archive, budget=40)
    source.array("a", ref)
    assert_refused(lambda: source.array("b", ref), "TENSOR_TOO_LARGE")


def test_require_shape() -> None:
    array = np.zeros((2, 3), dtype=np.float32)
    require_shape("w", array, (2, 3))
    require_shape("w", array, (None, 3))
    assert_refused(lambda: require_shape("w", array, (3, 2)), "TENSOR_SHAPE")
    assert_refused(lambda: require_shape("w", array, (2,)), "TENSOR_SHAPE")
    assert_refused(lambda: require_shape("w", array[:0], (None, 3)), "TENSOR_SHAPE")
