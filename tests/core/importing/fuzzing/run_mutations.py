"""Damage to settings word by word, and to archives of runs header by header, with sums that fit."""

from __future__ import annotations

import bz2
import gzip
import lzma
import re
from collections.abc import Callable
from random import Random

from tests.core.importing.fuzzing.byte_mutations import damaged

_BLOCK = 512
_FIELDS = {
    "name": (0, 100),
    "size": (124, 136),
    "kind": (156, 157),
    "link": (157, 257),
    "magic": (257, 265),
    "prefix": (345, 500),
}
_NAMES = (
    *(b"../x", b"/etc/passwd", b"run/config.yml", b"", b".", b"./", b"a\\b", b"a\0b", b"\xff", b"n" * 100, b"run//x"),
)
_SIZES = (b"00000000000", b"77777777777", b"\x80" + b"\xff" * 11, b"\x80" + bytes(10) + b"\x01", b"x" * 12, b"", b"1")
_KINDS = (b"0", b"\0", b"1", b"2", b"3", b"5", b"6", b"7", b"S", b"x", b"g", b"L", b"K", b"V", b"\xff")
_PACKERS: tuple[tuple[bytes, Callable[[bytes], bytes], Callable[[bytes], bytes]], ...] = (
    (b"\x1f\x8b", gzip.decompress, lambda data: gzip.compress(data, 1, mtime=0)),
    (b"BZh", bz2.decompress, lambda data: bz2.compress(data, 1)),
    (b"\xfd7zXZ", lzma.decompress, lambda data: lzma.compress(data, preset=0)),
)
_PIECE = re.compile(rb"[A-Za-z0-9_.+-]+|\s+|[^A-Za-z0-9_.+\s-]")
_WORDS: tuple[bytes, ...] = (
    *(
        b"nan",
        b".inf",
        b"-1",
        b"0",
        b"1e400",
        b"9" * 40,
        b"1.5",
        b"true",
        b"null",
        b"~",
        b"''",
        b'"',
        b"[4, 4]",
        b"{a: 1}",
    ),
    *(
        b"&a ",
        b"*a",
        b"<<: *a",
        b"!!python/object/apply:os.system",
        b"!!python/name:os.system ''",
        b"!x ",
        b"!!binary |",
    ),
    *(
        b"---\n",
        b"...\n",
        b"? ",
        b"- ",
        b": ",
        b"| \n",
        b"%YAML 1.3\n",
        b"\t",
        b"\0",
        b"\xff",
        b"\xef\xbb\xbf",
        b"#",
        b"//",
    ),
    *(
        b'include "x"\n',
        b"${HOME}",
        b"${?x}",
        b"+=",
        b"=",
        b"{",
        b"}",
        b"[",
        b"]",
        b'"""',
        b"\\u0000",
        b"a.b.c = 1\n",
        b",",
    ),
    *(
        b"16",
        b"linear",
        b"hash",
        b"ProgressiveBandHashGrid",
        b"mul2",
        b"+0.1",
        b"30.0",
        b"65537",
        b"1e-4",
        b"\n",
        b"  ",
    ),
)


def spoilt_settings(random: Random, file: bytes, other: bytes) -> bytes:
    """A file of settings behind the line of its name, after one to four changes to its words or lines."""
    name, _, text = file.partition(b"\n")
    if random.random() < 0.05:
        name = random.choice((b"config.yml", b"a.conf", b"specs.json", b"settings", other.partition(b"\n")[0]))
    if random.random() < 0.2:
        return name + b"\n" + damaged(random, text, other)
    for _ in range(random.choice((1, 1, 2, 3, 4))):
        text = _by_line(random, text, other) if random.random() < 0.3 else _by_word(random, text)
    return name + b"\n" + text


def repacked(random: Random, file: bytes, other: bytes) -> bytes:
    """A tar file, plain or packed, with another header or other bytes; packed again, or damaged as it is."""
    for magic, unpack, pack in _PACKERS:
        if file.startswith(magic) and random.random() < 0.7:
            return pack(repacked(random, unpack(file), other))
    if file[257:262] != b"ustar" or random.random() < 0.3:
        return damaged(random, file, other)
    for _ in range(random.choice((1, 1, 2))):
        file = _other_header(random, file)
    return file


def _by_word(random: Random, text: bytes) -> bytes:
    pieces = _PIECE.findall(text)
    if not pieces:
        return random.choice(_WORDS)
    at = random.randrange(len(pieces))
    match random.randrange(4):
        case 0:
            del pieces[at]
        case 1:
            pieces.insert(at, random.choice(_WORDS))
        case 2:
            pieces[at] = random.choice(pieces)
        case _:
            pieces[at] = random.choice(_WORDS)
    return b"".join(pieces)


def _by_line(random: Random, text: bytes, other: bytes) -> bytes:
    lines = text.splitlines(keepends=True) or [b"\n"]
    at = random.randrange(len(lines))
    match random.randrange(4):
        case 0:
            lines[at : at + 1] = [lines[at]] * random.choice((2, 3, 200))
        case 1:
            lines[at] = b"  " * random.choice((1, 2, 60)) + lines[at]
        case 2:
            lines.insert(at, random.choice(other.splitlines(keepends=True) or [b"\n"]))
        case _:
            random.shuffle(lines)
    return b"".join(lines)


def _other_header(random: Random, file: bytes) -> bytes:
    """One header's field changed, and its sum set right (most of the time)."""
    starts = [at for at in range(0, len(file), _BLOCK) if file[at + 257 : at + 262] == b"ustar"]
    if not starts:
        return damaged(random, file)
    at = random.choice(starts)
    field = random.choice(list(_FIELDS))
    low, high = _FIELDS[field]
    values = {"size": _SIZES, "kind": _KINDS}.get(field, _NAMES)
    header = bytearray(file[at : at + _BLOCK])
    header[low:high] = random.choice(values)[: high - low].ljust(high - low, b"\0")
    if random.random() < 0.9:
        header[148:156] = b" " * 8
        header[148:156] = b"%06o\0 " % sum(header)
    return file[:at] + bytes(header) + file[at + _BLOCK :]
