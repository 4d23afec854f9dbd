"""A zip file as a list of records whose every field may lie, and the bytes such a list makes."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, field, replace
from random import Random
from typing import Any

from tests.core.importing.fuzzing.byte_mutations import NUMBERS, little

_LOCAL_FIELDS = {"version": 2, "flags": 2, "method": 2, "time": 2, "date": 2, "crc": 4, "packed": 4, "size": 4}
_CENTRAL_FIELDS = {"made_by": 2, **_LOCAL_FIELDS}
_NAMES: tuple[bytes, ...] = (
    *(b"archive/../x", b"/x", b"x", b"archive/data.pkl", b"archive/data/0", b"archive/code/x.py", b"other/y"),
)
_NAMES += (b"archive/\xff", b"archive/a\0b", b"archive/" + b"n" * 600, b"archive/byteorder", b"archive/constants.pkl")


@dataclass(frozen=True)
class Record:
    """One entry. What ``local`` and ``central`` name overrides the truth in that header."""

    name: bytes
    data: bytes
    descriptor: str = ""
    """Behind the data: "" none, "32" or "64" with those sizes, "bare" 32-bit without a signature."""
    gap: bytes = b""
    local: dict[str, int] = field(default_factory=dict)
    central: dict[str, int] = field(default_factory=dict)
    local_name: bytes | None = None
    local_extra: bytes = b""
    central_extra: bytes = b""
    in_directory: bool = True

    def truth(self) -> dict[str, int]:
        flags = 0x0808 if self.descriptor else 0x0800
        sizes = {"packed": len(self.data), "size": len(self.data)}
        return {"version": 20, "made_by": 0, "flags": flags, "method": 0, "time": 0, "date": 0x21} | sizes


@dataclass(frozen=True)
class Ending:
    """The records behind the directory, and what they claim instead of the truth."""

    claims: dict[str, int] = field(default_factory=dict)
    wide: bool = False
    wide_claims: dict[str, int] = field(default_factory=dict)
    comment: bytes = b""
    tail: bytes = b""


def archive_bytes(records: list[Record], ending: Ending | None = None) -> bytes:
    """The file."""
    body, directory, count = b"", b"", 0
    for record in records:
        offset = len(body) + len(record.gap)
        body += record.gap + _local(record) + record.data + _descriptor(record)
        if record.in_directory:
            directory += _central(record, offset)
            count += 1
    return body + directory + _ending(ending or Ending(), len(body), len(directory), count)


def _local(record: Record) -> bytes:
    values = record.truth() | {"crc": zlib.crc32(record.data)}
    if record.descriptor:
        values |= {"crc": 0, "packed": 0, "size": 0}
    values |= record.local
    name = record.name if record.local_name is None else record.local_name
    lengths = little(record.local.get("name_length", len(name)), 2) + little(len(record.local_extra), 2)
    packed = b"".join(little(values[key], width) for key, width in _LOCAL_FIELDS.items())
    return b"PK\x03\x04" + packed + lengths + name + record.local_extra


def _descriptor(record: Record) -> bytes:
    if not record.descriptor:
        return b""
    wide = record.descriptor == "64"
    signature = b"" if record.descriptor == "bare" else b"PK\x07\x08"
    values = struct.pack("<QQ" if wide else "<II", len(record.data), len(record.data))
    return signature + little(zlib.crc32(record.data), 4) + values


def _central(record: Record, offset: int) -> bytes:
    values = record.truth() | {"crc": zlib.crc32(record.data), "offset": offset} | record.central
    packed = b"".join(little(values[key], width) for key, width in _CENTRAL_FIELDS.items())
    lengths = [record.central.get("name_length", len(record.name)), len(record.central_extra)]
    lengths += [record.central.get(key, 0) for key in ("comment_length", "disk", "internal")]
    rest = b"".join(little(value, 2) for value in lengths) + little(0, 4) + little(values["offset"], 4)
    return b"PK\x01\x02" + packed + rest + record.name + record.central_extra


def _ending(ending: Ending, offset: int, size: int, count: int) -> bytes:
    truth = {"disk": 0, "start_disk": 0, "here": count, "count": count, "size": size, "offset": offset}
    wide = b""
    if ending.wide:
        values = truth | ending.wide_claims
        record = little(values.get("record", 44), 8) + little(45, 2) + little(45, 2)
        record += little(values["disk"], 4) + little(values["start_disk"], 4)
        record += b"".join(little(values[key], 8) for key in ("here", "count", "size", "offset"))
        locator = little(values.get("locator_disk", 0), 4) + little(values.get("at", offset + size), 8)
        wide = b"PK\x06\x06" + record + b"PK\x06\x07" + locator + little(values.get("disks", 1), 4)
    values = truth | ending.claims
    widths = {"disk": 2, "start_disk": 2, "here": 2, "count": 2, "size": 4, "offset": 4}
    packed = b"".join(little(values[key], width) for key, width in widths.items())
    length = little(values.get("comment_length", len(ending.comment)), 2)
    return wide + b"PK\x05\x06" + packed + length + ending.comment + ending.tail


def lied(random: Random, records: list[Record], ending: Ending) -> tuple[list[Record], Ending]:
    """One to three lies, anywhere."""
    records = list(records)
    for _ in range(random.choice((1, 1, 2, 3))):
        if random.random() < 0.25:
            ending = _lied_ending(random, ending)
        else:
            at = random.randrange(len(records))
            records[at : at + 1] = _lied_record(random, records[at], records)
    return records, ending


def _lied_ending(random: Random, ending: Ending) -> Ending:
    key = random.choice(("disk", "start_disk", "here", "count", "size", "offset", "comment_length"))
    wide_key = random.choice(("record", "disk", "here", "count", "size", "offset", "at", "disks", "locator_disk"))
    value = random.choice(NUMBERS)
    changes: tuple[dict[str, Any], ...] = (
        *({"claims": ending.claims | {key: value}}, {"claims": ending.claims | {key: value}}, {"wide": True}),
        {"wide": True, "wide_claims": ending.wide_claims | {wide_key: value}},
        *({"comment": random.randbytes(random.randrange(1, 9))}, {"tail": random.randbytes(random.randrange(1, 40))}),
    )
    return replace(ending, **random.choice(changes))


def _lied_record(random: Random, record: Record, others: list[Record]) -> list[Record]:
    key = random.choice([*_CENTRAL_FIELDS, "offset", "name_length", "comment_length", "disk"])
    value = random.choice((*NUMBERS, len(record.data) - 1, len(record.data) + 1, 1, 8, 0x0808, 0x0001, 0x2000))
    central, local, extra = record.central | {key: value}, record.local | {key: value}, random.randbytes(9)
    changes: tuple[dict[str, Any], ...] = (
        *({"central": central}, {"central": central}, {"local": local}, {"central": central, "local": local}),
        {"name": random.choice(_NAMES), "local_name": random.choice((None, record.name))},
        *({"in_directory": False}, {"gap": extra}, {"descriptor": random.choice(("", "32", "64", "bare"))}),
        {"local_extra": extra, "central_extra": random.choice((b"", extra))},
    )
    if random.random() < 0.75:
        return [replace(record, **random.choice(changes))]
    return random.choice(([record, random.choice(others)], [_compressed(record)], [_widened(random, record)]))


def _compressed(record: Record) -> Record:
    """The entry as other writers would have it: deflated, and true."""
    packer = zlib.compressobj(wbits=-15)
    packed = packer.compress(record.data) + packer.flush()
    sizes = {"method": 8, "size": len(record.data), "crc": zlib.crc32(record.data)}
    return replace(record, data=packed, local=record.local | sizes, central=record.central | sizes)


def _widened(random: Random, record: Record) -> Record:
    """Sizes in a zip64 field, true or not."""
    size = random.choice((len(record.data), *NUMBERS))
    numbers = [size] * random.choice((0, 1, 2, 3, 4))
    extra = little(1, 2) + little(8 * len(numbers), 2) + b"".join(little(value, 8) for value in numbers)
    keys = random.choice((("size",), ("size", "packed"), ("size", "packed", "offset")))
    return replace(
        record,
        central=record.central | dict.fromkeys(keys, 0xFFFFFFFF),
        central_extra=extra,
        local=record.local | {key: 0xFFFFFFFF for key in keys if key != "offset"},
        local_extra=random.choice((b"", extra)),
    )
