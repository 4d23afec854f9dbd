"""Damage to settings word by word, and to archives of runs header by header, with sums that fit."""

from __future__ import annotations

import bz2
import gzip
import lzma
from collections.abc import Callable
from random import Random

from tests.core.importing.fuzzing.byte_mutations import damaged, reworded

_BLOCK = 512
_NAMES = (
    *(b"../x", b"/etc/passwd", b"run/config.yml", b"", b".", b"./", b"a\\b", b"a\0b", b"\xff", b"n" * 100, b"run//x"),
)
_SIZES = (b"00000000000", b"77777777777", b"\x80" + b"\xff" * 11, b"\x80" + bytes(10) + b"\x01", b"x" * 12, b"", b"1")
_KINDS = (b"0", b"\0", b"1", b"2", b"3", b"5", b"6", b"7", b"S", b"x", b"g", b"L", b"K", b"V", b"\xff")
_FIELDS = (
    *((0, 100, _NAMES), (124, 136, _SIZES), (156, 157, _KINDS), (157, 257, _NAMES)),
    *((257, 265, _NAMES), (345, 500, _NAMES)),
)
"""Name, size, kind, link, magic and prefix in a header, and what they may be."""
_PACKERS: tuple[tuple[bytes, Callable[[bytes], bytes], Callable[[bytes], bytes]], ...] = (
    (b"\x1f\x8b", gzip.decompress, lambda data: gzip.compress(data, 1, mtime=0)),
    (b"BZh", bz2.decompress, lambda data: bz2.compress(data, 1)),
    (b"\xfd7zXZ", lzma.decompress, lambda data: lzma.compress(data, preset=0)),
)
_WORDS = (
    *b"nan|.inf|-1|0|1e400|1.5|true|null|~|''|\"|[4, 4]|{a: 1}|&a |*a|<<: *a|!x |? |- |: |\t|\0|\xff".split(b"|"),
    *b"16|linear|hash|ProgressiveBandHashGrid|mul2|+0.1|30.0|65537|1e-4|\n|  |+=|=|{|}|[|]|\\u0000|,|#|//".split(b"|"),
    *(
        b"!!binary |",
        b"!!python/object/apply:os.system",
        b"!!python/name:os.system ''",
        b"9" * 40,
        b"| \n",
        b"---\n",
        b"...\n",
    ),
    *(b"%YAML 1.3\n", b"\xef\xbb\xbf", b'include "x"\n', b"${HOME}", b"${?x}", b'"""', b"a.b.c = 1\n"),
)


def spoilt_settings(random: Random, file: bytes, other: bytes) -> bytes:
    """A file of settings behind the line of its name, after one to four changes to its words or lines."""
    name, _, text = file.partition(b"\n")
    if random.random() < 0.05:
        name = random.choice((b"config.yml", b"a.conf", b"specs.json", b"settings", other.partition(b"\n")[0]))
    if random.random() < 0.2:
        return name + b"\n" + damaged(random, text, other)
    return name + b"\n" + reworded(random, text, _WORDS, other)


def repacked(random: Random, file: bytes, other: bytes) -> bytes:
    """A tar file, plain or packed, with another header or other bytes; packed again, or damaged as it is."""
    for magic, unpack, pack in _PACKERS:
        if file.startswith(magic) and random.random() < 0.7:
            return pack(repacked(random, unpack(file), other))
    if file[257:262] != b"ustar" or random.random() < 0.3:
        return damaged(random, file, other)
    for _ in range(random.choice((1, 1, 2))):
        starts = [at for at in range(0, len(file), _BLOCK) if file[at + 257 : at + 262] == b"ustar"]
        if starts:
            file = _other_header(random, file, random.choice(starts))
    return file


def _other_header(random: Random, file: bytes, at: int) -> bytes:
    """The field of a header changed, and its sum set right (most of the time)."""
    low, high, values = random.choice(_FIELDS)
    header = bytearray(file[at : at + _BLOCK])
    header[low:high] = random.choice(values)[: high - low].ljust(high - low, b"\0")
    if random.random() < 0.9:
        header[148:156] = b" " * 8
        header[148:156] = b"%06o\0 " % sum(header)
    return file[:at] + bytes(header) + file[at + _BLOCK :]
