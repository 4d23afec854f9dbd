"""What a pickle may cost: every way to ask for more work than the file is long is counted."""

from __future__ import annotations

import struct

import pytest

from regnf_core.errors import FieldFormatError
from regnf_core.importing.pickle.pickle_machine import PickleLimits
from regnf_core.importing.pickle.pickle_reader import read_pickle
from tests.core.importing.archives import assert_refused, text

PROTO = b"\x80\x02"


PAIRS, NOTHINGS = b"(" + b"NN\x86" * 15 + b"l", b"(" + b"N" * 30 + b"t"
STORAGE = b"(" + text("storage") + b"ctorch\nFloatStorage\n" + text("0") + text("cpu") + b"K\x01" + b"N" * 30 + b"t"


@pytest.mark.parametrize(
    "body",
    [
        b"N0" * 60 + b"N",
        b"N" + b"".join(b"q" + bytes([i]) for i in range(20)),
        PAIRS + b"q\x00" + b"ccollections\nOrderedDict\nh\x00\x85R0" * 5,
        PAIRS + b"q\x00" + b"ccollections\ndefaultdict\nNh\x00\x86R0" * 5,
        NOTHINGS + b"q\x00" + b"ctorch\nSize\nh\x00R0" * 5,
        NOTHINGS + b"q\x00" + b"cos\nsystem\nh\x00\x810" * 5,
        STORAGE + b"q\x00" + b"h\x00Q0" * 5,
    ],
    ids=["opcodes", "memo", "pairs", "pairs of a defaultdict", "arguments", "of a placeholder", "persistent ids"],
)
def test_work_is_counted(body: bytes) -> None:
    """Arguments that are remembered can be used again and again at the price of a few opcodes: they cost their length.
    Each body asks for more than a hundred opcodes' work, or for more than ten remembered values.
    """
    limits = PickleLimits(opcodes=100, memo=10)
    assert_refused(lambda: read_pickle(memoryview(PROTO + body + b"."), limits), "PICKLE_TOO_COMPLEX")


def keys_of_one_hash(count: int) -> list[tuple[int, int]]:
    """Pairs of integers that Python gives the same hash: its mixing of a tuple's parts can be run backwards."""
    first, second, start, modulus = 11400714785074694791, 14029467366897019727, 2870177450012600261, 1 << 64
    inverse, target, keys = pow(second, -1, modulus), 12345678901234567, []
    for lead in range(1, 1 << 20):
        mixed = (start + lead * second) % modulus
        mixed = ((mixed << 31) | (mixed >> 33)) * first % modulus
        other = (target - mixed) * inverse % modulus
        other -= modulus if other >> 63 else 0
        if 1 < abs(other) < (1 << 61) - 1:
            keys.append((lead, other))
        if len(keys) == count:
            break
    return keys


def test_keys_that_share_one_hash_cost_more_than_others() -> None:
    """A dictionary of n such keys takes n^2 comparisons: a file of megabytes would take hours."""
    keys = keys_of_one_hash(11_000)
    assert len({hash(key) for key in keys}) == 1
    pairs = [b"J" + struct.pack("<i", a) + b"\x8a\x08" + struct.pack("<q", b) + b"\x86" for a, b in keys]
    as_items = b"}(" + b"".join(pair + b"N" for pair in pairs) + b"u."
    assert_refused(lambda: read_pickle(memoryview(PROTO + as_items)), "PICKLE_TOO_COMPLEX")
    as_argument = b"ccollections\nOrderedDict\n(" + b"".join(pair + b"N\x86" for pair in pairs) + b"l\x85R."
    assert_refused(lambda: read_pickle(memoryview(PROTO + as_argument)), "PICKLE_TOO_COMPLEX")


def test_some_tuples_as_keys_are_taken_and_tuples_of_tuples_of_tuples_refused() -> None:
    """The latter, shared by reference, are short in the file and endless to hash."""
    pairs = b"".join(b"K" + bytes([i]) + b"K\x07\x86N" for i in range(200))
    assert len(read_pickle(memoryview(PROTO + b"}(" + pairs + b"u."))) == 200
    nested = b"K\x01" + (b"q\x000(" + b"h\x00" * 16 + b"t") * 4
    assert_refused(lambda: read_pickle(memoryview(PROTO + b"}" + nested + b"Ns.")), "PICKLE_MALFORMED")


def test_what_asks_for_too_much_is_named() -> None:
    """So that whoever uploads a map of millions of nodes knows what is too large."""
    body = b"cmodel.feature_octree\nFeatureOctree\n)\x81}(" + b"".join(b"K\x01K\x02" for _ in range(200)) + b"ub."
    with pytest.raises(FieldFormatError, match=r"model\.feature_octree\.FeatureOctree") as caught:
        read_pickle(memoryview(PROTO + body), PickleLimits(opcodes=100))
    assert caught.value.reason == "PICKLE_TOO_COMPLEX"
