from __future__ import annotations

import collections
import io
import os
import pickle
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from regnf_core.importing.containers.legacy_container import read_archive
from regnf_core.importing.pickle.pickle_machine import GlobalRef, Placeholder, TensorRef
from regnf_core.importing.pickle.pickle_reader import read_pickle
from tests.core.importing.archives import assert_refused, integer, storage, tensor, text

PROTO = b"\x80\x02"


def read(data: bytes) -> Any:
    return read_pickle(memoryview(data))


def assert_rejected(data: bytes, reason: str) -> None:
    assert_refused(lambda: read(data), reason)


def read_saved(value: object, protocol: int = 2) -> Any:
    """What the reader makes of a value that torch.save wrote."""
    buffer = io.BytesIO()
    torch.save(value, buffer, pickle_protocol=protocol)
    return read_pickle(read_archive(memoryview(buffer.getvalue())).read("data.pkl"))


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_plain_values_come_back_as_they_were(protocol: int) -> None:
    values = {
        "none": None,
        "flags": [True, False],
        "integers": (0, 255, 65535, -1, 2**31 - 1, -(2**63), 2**100),
        "float": 2.5,
        "text": ["", "ü", "x" * 300],
        "bytes": b"\x00\xff" if protocol > 2 else None,
        "nested": {"a": {1: [(), (1,), (1, 2), (1, 2, 3), (1, 2, 3, 4)]}},
    }
    assert read(pickle.dumps(values, protocol)) == values
    assert read_saved(values, protocol) == values


@pytest.mark.parametrize("protocol", [2, 4])
def test_plain_containers_and_numpy_scalars_are_understood(protocol: int) -> None:
    values = {
        "ordered": collections.OrderedDict(a=1, b=2),
        "counter": collections.Counter({10: 2}),
        "default": collections.defaultdict(list, {"k": [1]}),
        "set": {3},
        "frozen": frozenset([4]),
        "size": torch.Size([2, 3]),
        "scalars": [np.float64(1.5), np.float32(0.25), np.int64(-7), np.bool_(True)],
    }
    assert read_saved(values, protocol) == {
        "ordered": {"a": 1, "b": 2},
        "counter": {10: 2},
        "default": {"k": [1]},
        "set": [3],
        "frozen": (4,) if protocol == 4 else [4],
        "size": (2, 3),
        "scalars": [1.5, 0.25, -7, True],
    }


def test_numpy_scalars_under_their_old_module_name_are_understood() -> None:
    scalar = pickle.dumps(np.float64(1.5), 2).replace(b"numpy._core.multiarray", b"numpy.core.multiarray")
    assert read(scalar) == 1.5


@pytest.mark.parametrize("protocol", [2, 4])
def test_tensors_become_descriptions(protocol: int) -> None:
    ref = read_saved({"w": torch.nn.Parameter(torch.zeros(4, 3, dtype=torch.bfloat16).t())}, protocol)["w"]
    assert isinstance(ref, TensorRef)
    assert (ref.shape, ref.strides, ref.offset, ref.plain) == ((3, 4), (1, 3), 0, True)
    assert (ref.storage.dtype, ref.storage.count, ref.storage.device) == ("bfloat16", 12, "cpu")


def test_a_tensor_with_a_conjugate_bit_is_more_than_a_view() -> None:
    ref = read_saved(torch.ones(2, dtype=torch.complex64).conj())
    assert isinstance(ref, TensorRef)
    assert not ref.plain
    assert ref.storage.dtype is None


def test_other_objects_are_inert(tmp_path: Path) -> None:
    values = read_saved({"path": tmp_path, "array": np.ones(3), "device": torch.device("cpu"), "dtype": torch.float32})
    assert isinstance(values["path"], Placeholder)
    assert values["array"].full_name.endswith("multiarray._reconstruct")
    assert isinstance(values["dtype"], GlobalRef)


class _Calls:
    """Pickles to a call of any function with any arguments."""

    def __init__(self, function: Callable[..., Any], *args: Any) -> None:
        self.reduction = (function, args)

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return self.reduction


@pytest.mark.parametrize("protocol", [2, 4])
@pytest.mark.parametrize("function", [os.system, eval, exec, os.mkdir])
def test_calls_have_no_effect(tmp_path: Path, protocol: int, function: Callable[..., Any]) -> None:
    canary = tmp_path / "canary"
    argument = {os.system: f"touch {canary}", os.mkdir: str(canary)}.get(
        function, f"open({str(canary)!r}, 'w').close()"
    )
    data = pickle.dumps(_Calls(function, argument), protocol)
    value = read(data)
    assert isinstance(value, Placeholder)
    assert value.full_name.rpartition(".")[2] == function.__name__
    assert not canary.exists()
    pickle.loads(data)  # the canary works: the stock reader does run the call
    assert canary.exists()


def test_a_name_put_together_through_the_memo_is_still_only_a_name() -> None:
    value = read(b"\x80\x04\x8c\x02os\x94\x8c\x06system\x9400h\x00h\x01\x93" + text("true") + b"\x85R.")
    assert isinstance(value, Placeholder)
    assert value.full_name == "os.system"


def test_everything_done_to_a_placeholder_is_without_effect() -> None:
    made = b"cmodel\nThing\n)R"
    used = made + b"}b" + text("key") + b"Ns" + b"Na" + b"(NNe" + b"(NNu" + b"}b"
    value = read(PROTO + used + b")R" + b".")
    assert isinstance(value, Placeholder)
    assert value.full_name == "model.Thing"
    assert isinstance(read(PROTO + b"cmodel\nThing\n)}\x92."), Placeholder)
    assert isinstance(read(PROTO + b"cmodel\nThing\n)\x81."), Placeholder)


@pytest.mark.parametrize(
    "opcodes",
    [
        b"(ios\nsystem\n",  # INST
        b"(cos\nsystem\no",  # OBJ
        b"\x82\x01",  # EXT1
        b"\x83\x01\x00",  # EXT2
        b"\x84\x01\x00\x00\x00",  # EXT4
        b"P0\n",  # PERSID
        b"\x97",  # NEXT_BUFFER
        b"\x98",  # READONLY_BUFFER
        *(b"I1\n", b"L1L\n", b"F1.5\n", b"S'a'\n", b"Va\n", b"g0\n", b"\xff"),
    ],
)
def test_opcodes_that_no_checkpoint_needs_are_refused(opcodes: bytes) -> None:
    assert_rejected(PROTO + opcodes + b".", "PICKLE_OPCODE_NOT_ALLOWED")


@pytest.mark.parametrize("data", [b"", b"\x80", b"N.", b"\x80\x00N.", b"\x80\x01N.", b"\x80\x06N."])
def test_other_protocols_are_refused(data: bytes) -> None:
    assert_rejected(data, "PICKLE_PROTOCOL")


@pytest.mark.parametrize(
    "body",
    [
        b"",  # nothing to return
        b"NN",  # two values
        b"(",  # a mark left over
        b"0",  # POP of nothing
        *(b"a", b"Na"),
        b"]NNs",  # a key for a list
        b"}Na",  # an item for a dict
        b"}(Nu",  # a key without a value
        b"}]Ns",  # an unhashable key
        b"h\x07",  # a memo never filled
        b"(1t",  # a mark used twice
        b"t",
        b"N)R",  # a call of None
        b"cos\nsystem\nNR",  # arguments that are no tuple
        b"Nq\x00}b",  # state for None
        *(b"NQ", text("storage") + b"Q"),
        b"X\x05\x00\x00\x00ab",  # a string cut short
        b"X\x01\x00\x00\x00\xff",  # not UTF-8
        *(b"cos\x00\nsystem\n", b"c" + b"a" * 600, b"\x93", b"NN\x93"),
        b"\x95\xff\xff\xff\xff\xff\xff\xff\x7fN",  # a frame beyond the end
        b"\x95\x02\x00\x00\x00\x00\x00\x00\x00X\x00\x00\x00\x00",  # an opcode across a frame's end
        b"\x95\x0b\x00\x00\x00\x00\x00\x00\x00\x95\x01\x00\x00\x00\x00\x00\x00\x00N",  # a frame within a frame
        tensor("0", (2,), (1,)) + b"}b",  # state for a tensor
        tensor("0", (2,), (1,)) + b"NNs",  # an item of a tensor
        *(tensor("0", (2,), (1, 1)), tensor("0", (-2,), (1,)), tensor("0", (2,), (-1,))),
        *(tensor("0", (2,), (1,), offset=-1), tensor("../0", (2,), (1,)), storage("0", -1)),
        *(b"ctorch._utils\n_rebuild_tensor_v2\n)R", b"ctorch._utils\n_rebuild_parameter\n)R"),
    ],
)
def test_pickles_that_make_no_sense_are_refused(body: bytes) -> None:
    assert_rejected(PROTO + body + b".", "PICKLE_MALFORMED")


def test_a_pickle_cut_short_anywhere_and_a_second_behind_the_first_are_refused() -> None:
    whole = pickle.dumps({"a": [1, 2.5, ("x", None)], "b": np.float64(3)}, 4)
    for end in range(2, len(whole)):
        assert_rejected(whole[:end], "PICKLE_MALFORMED")
    assert_rejected(whole + whole, "PICKLE_TRAILING_DATA")


def test_a_tensor_made_by_an_unknown_function_carries_its_name() -> None:
    odd = b"ctorch._utils\n_rebuild_tensor_v2\n(cevil\nstorage\n)R" + integer(0) + b"))\x89}tR."
    value = read(PROTO + odd)
    assert isinstance(value, Placeholder)
    assert value.full_name == "evil.storage"


def test_a_billion_laughs_cost_nothing() -> None:
    body = b"]q\x00" + text("lol") + b"a0"
    for level in range(1, 100):
        below = b"h" + bytes([level - 1])
        body += b"]q" + bytes([level]) + b"(" + below * 10 + b"e0"
    value = read(PROTO + body + b"h\x63.")
    assert [len(value), len(value[0]), value[0] is value[9]] == [10, 10, True]


@pytest.mark.parametrize("opener", [b"(", b"]", b"}", b"N", b")"])
def test_endless_nesting_is_refused(opener: bytes) -> None:
    assert_rejected(PROTO + opener * 200_000, "PICKLE_TOO_DEEP")


def test_deep_and_circular_values() -> None:
    deep = b")" + b"\x85" * 100_000
    assert isinstance(read(PROTO + deep + b"."), tuple)
    assert_rejected(PROTO + b"}" + deep + b"Ns.", "PICKLE_MALFORMED")  # as a key
    value = read(PROTO + b"]q\x00h\x00a.")
    assert value[0] is value


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        (b"\x8a\xff" + b"\x7f" * 255, "PICKLE_INTEGER_TOO_LARGE"),
        (b"\x8b" + struct.pack("<I", 1 << 20) + bytes(1 << 20), "PICKLE_INTEGER_TOO_LARGE"),
        (b"}\x8a\x0b" + b"\x7f" * 11 + b"Ns", "PICKLE_INTEGER_TOO_LARGE"),  # as a key
        (b"X" + struct.pack("<I", 1 << 31), "PICKLE_STRING_TOO_LARGE"),
    ],
)
def test_giant_integers_and_strings_are_refused(body: bytes, reason: str) -> None:
    assert_rejected(PROTO + body + b".", reason)
