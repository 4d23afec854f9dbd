"""Pickles that would run, lie or never end, in an archive that is sound otherwise, each with what becomes of it."""

from __future__ import annotations

import struct
from pathlib import Path

from tests.core.importing.archives import integer, storage, tensor, text
from tests.core.importing.fuzzing.pickle_grammar import contiguous
from tests.core.importing.fuzzing.seeds import Seeds
from tests.gate.bad_containers import Build, Files

CANARY = Path("regnf-canary")
"""A file in the current folder that appears if anything runs."""
_TOUCH = text(f"touch {CANARY}") + b"\x85R"
WEIGHT = "_model.field.glin1.bias"
UNSAFE = "rejected UNSAFE_GLOBAL_IN_WEIGHTS"


def state(seeds: Seeds, weight: bytes | None = None) -> bytes:
    """The checkpoint's state, one weight made by other opcodes."""
    entries = b""
    for name, key, shape in seeds.tensors:
        made = weight if weight is not None and name == WEIGHT else tensor(key, shape, contiguous(shape))
        entries += text(name) + made
    return text("pipeline") + b"}(" + entries + b"u"


def checkpoint(seeds: Seeds, protocol: bytes, weight: bytes | None, beside: bytes, end: bytes = b".") -> bytes:
    """An archive with a whole pickle: the state, and beside it whatever the opcodes make."""
    rest = text("hooks") + beside + b"s" if beside else b""
    return seeds.with_pickle(b"\x80" + protocol + b"}" + state(seeds, weight) + b"s" + rest + end)


def weight(opcodes: bytes, protocol: int = 2) -> Build:
    """A file with the opcodes in place of a weight."""
    return lambda seeds: checkpoint(seeds, bytes([protocol]), opcodes, b"")


def beside(opcodes: bytes, end: bytes = b".") -> Build:
    """A file with sound weights, and what the opcodes make beside them."""
    return lambda seeds: checkpoint(seeds, b"\x02", None, opcodes, end)


def billion_laughs() -> bytes:
    body = b"]q\x00" + text("lol") + b"a0"
    for level in range(1, 40):
        body += b"]q" + bytes([level]) + b"(" + (b"h" + bytes([level - 1])) * 10 + b"e0"
    return body + b"h\x27"


def frame_of(length: int) -> bytes:
    return b"\x95" + struct.pack("<Q", length)


MEMO = b"\x8c\x02os\x94\x8c\x06system\x940" + b"0h\x00h\x01\x93"
"""os and system, remembered apart and put together."""
PICKLES: Files = {
    "os.system": (weight(b"cos\nsystem\n" + _TOUCH), UNSAFE),
    "posix.system": (weight(b"cposix\nsystem\n" + _TOUCH), UNSAFE),
    "eval": (weight(b"cbuiltins\neval\n" + text(f"open('{CANARY}', 'w')") + b"\x85R"), UNSAFE),
    "os.system beside the weights": (beside(b"cos\nsystem\n" + _TOUCH), "ready"),
    "STACK_GLOBAL through the memo": (weight(MEMO + _TOUCH, 4), UNSAFE),
    "INST": (weight(b"(" + text(f"touch {CANARY}") + b"ios\nsystem\n"), "rejected PICKLE_OPCODE_NOT_ALLOWED"),
    "OBJ": (weight(b"(cos\nsystem\n" + text(f"touch {CANARY}") + b"o"), "rejected PICKLE_OPCODE_NOT_ALLOWED"),
    "EXT1": (weight(b"\x82\x01"), "rejected PICKLE_OPCODE_NOT_ALLOWED"),
    "EXT4": (weight(b"\x84\x01\x00\x00\x00"), "rejected PICKLE_OPCODE_NOT_ALLOWED"),
    "resolve_name": (weight(b"cpkgutil\nresolve_name\n" + text("os:system") + b"\x85R" + _TOUCH), UNSAFE),
    "attrgetter": (weight(b"coperator\nattrgetter\n" + text("system") + b"\x85Rcos\n__dict__\n\x85R"), UNSAFE),
    "partial": (weight(b"cfunctools\npartial\ncos\nsystem\n" + text(f"touch {CANARY}") + b"\x86R)R"), UNSAFE),
    "nested torch.load": (weight(b"ctorch.storage\n_load_from_bytes\n" + text("x") + b"\x85R"), UNSAFE),
    "object array": (
        weight(b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85" + text("b") + b"\x87R"),
        UNSAFE,
    ),
    "object scalar": (
        weight(b"cnumpy.core.multiarray\nscalar\ncnumpy\ndtype\n" + text("O8") + b"\x85R" + text("x") + b"\x86R"),
        UNSAFE,
    ),
    "PERSID as text": (weight(b"Pstorage\n"), "rejected PICKLE_OPCODE_NOT_ALLOWED"),
    "a persistent id that is no storage": (weight(text("x") + b"Q"), "rejected PICKLE_MALFORMED"),
    "BUILD on a tensor": (weight(tensor("0", (6,), (1,)) + b"}b"), "rejected PICKLE_MALFORMED"),
    "SETITEM on a tensor": (weight(tensor("0", (6,), (1,)) + b"K\x00K\x00s"), "rejected PICKLE_MALFORMED"),
    "a frame too long": (weight(frame_of(1 << 40) + b"N", 4), "rejected PICKLE_MALFORMED"),
    "an opcode across a frame's end": (weight(frame_of(2) + text("x"), 4), "rejected PICKLE_MALFORMED"),
    "two pickles in one": (beside(b"N", b".\x80\x02N."), "rejected PICKLE_TRAILING_DATA"),
    "billion laughs": (weight(billion_laughs()), "rejected TENSOR_EXPECTED"),
    "billion laughs beside the weights": (beside(billion_laughs()), "ready"),
    "deep nesting": (beside(b"](" * 300), "rejected PICKLE_TOO_DEEP"),
    "a deep stack": (beside(b"]" * 200_000), "rejected PICKLE_TOO_DEEP"),
    "giant integer": (weight(integer(1 << 2000)), "rejected PICKLE_INTEGER_TOO_LARGE"),
    "giant key": (beside(b"}" + integer(1 << 80) + b"Ns"), "rejected PICKLE_INTEGER_TOO_LARGE"),
    "a string of 2 GiB": (weight(b"X" + struct.pack("<I", 1 << 31)), "rejected PICKLE_STRING_TOO_LARGE"),
    "missing storage": (weight(tensor("12345", (6,), (1,))), "rejected TENSOR_STORAGE_MISSING"),
    "a storage's size that lies": (weight(tensor("0", (6,), (1,), count=60)), "rejected TENSOR_STORAGE_MISMATCH"),
    "a bare storage": (weight(storage("0", 6)), "rejected TENSOR_EXPECTED"),
}
