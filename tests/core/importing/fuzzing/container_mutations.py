"""Damage that knows how a container is built, so that what is changed is read and not refused at the first check."""

from __future__ import annotations

import io
import json
import pickletools
import sqlite3
import zipfile
from collections.abc import Callable
from random import Random

from tests.core.importing.fuzzing.archive_model import Ending, Record, archive_bytes, lied
from tests.core.importing.fuzzing.byte_mutations import NUMBERS, damaged, little, number, reworded
from tests.core.importing.fuzzing.header_mutations import altered
from tests.core.importing.fuzzing.pickle_grammar import opcodes_of, respelt
from tests.core.importing.fuzzing.run_mutations import repacked, spoilt_settings
from tests.core.importing.fuzzing.wire_mutations import rewired

_WORDS = (
    *b"nan -inf 1e400 1e-400 -1 0 3000000000 0x10 1_0 \xff list uchar double vertex face property element".split(b" "),
    *b"end_header comment ascii binary_big_endian f v -1/2/3 1//1 call csh facet endsolid \\ True '|O' '>f8'".split(
        b" "
    ),
    *(b"'<f2'", b"'<i8'", b"(0,)", b"(9, 9, 9, 1)", b"(1152921504606846976,)", b"(,)", b"", b"9" * 30),
)
_LEGACY_PICKLES = 5
_HEADER_END = b"end_header\n"
_STATEMENTS = (
    *("DELETE FROM {table} WHERE rowid % 2", "DELETE FROM {table}", "INSERT INTO {table} SELECT * FROM {table}"),
    *("INSERT INTO {table} SELECT * FROM {table} LIMIT 1", "UPDATE {table} SET {column} = {value}"),
    *("UPDATE {table} SET {column} = {value} WHERE rowid = 1", "ALTER TABLE {table} RENAME COLUMN {column} TO odd"),
    *("ALTER TABLE {table} DROP COLUMN {column}", "ALTER TABLE {table} RENAME TO odd"),
    *("ALTER TABLE {table} ADD COLUMN {column}_more", "CREATE VIEW odd AS SELECT * FROM {table}"),
    "CREATE TABLE occupancy_layer_data AS SELECT * FROM {table}",
    *("CREATE TABLE other_tsdf_layer_data AS SELECT * FROM {table}", "CREATE INDEX odd ON {table}({column})"),
    *("CREATE TRIGGER odd AFTER INSERT ON {table} BEGIN DELETE FROM {table}; END", "PRAGMA user_version = {value}"),
    *("PRAGMA application_id = {value}", "PRAGMA auto_vacuum = 1"),
)
_BLOB = "a block"
_VALUES: tuple[str, ...] = (
    *("NULL", "1", "-1", "0", "1e308", "9e999", "'x'", "x''", "9223372036854775807", "1048577", _BLOB),
    *("zeroblob(4096)", "zeroblob(2000000)", "cast(zeroblob(4096) as text)", "{random}"),
)


def spoilt_run(random: Random, file: bytes, other: bytes) -> bytes:
    """An archive of a run: a zip as any other, a tar by its headers."""
    return spoilt(random, file, other) if file.startswith(b"PK\x03\x04") else repacked(random, file, other)


def spoilt(random: Random, file: bytes, other: bytes) -> bytes:
    """An archive with damage mostly to one entry, which is then packed as if it belonged; any other file blindly."""
    if not file.startswith(b"PK\x03\x04") or random.random() < 0.2:
        return damaged(random, file, other)
    with zipfile.ZipFile(io.BytesIO(file)) as archive:
        records = [Record(name.encode(), archive.read(name)) for name in archive.namelist()]
    if random.random() < 0.2:
        return archive_bytes(*lied(random, records, Ending()))
    at = random.randrange(len(records))
    name, data = records[at].name, records[at].data
    if name.endswith(b"data.pkl") and random.random() < 0.7:
        codes = opcodes_of(data)
        records[at] = Record(name, respelt(random, codes, codes))
    else:
        records[at] = Record(name, damaged(random, data, other))
    return archive_bytes(records)


def spoilt_legacy(random: Random, file: bytes, other: bytes) -> bytes:
    """One of the five pickles respelt, or the storages behind them damaged."""
    parts, rest = [], file
    for _ in range(_LEGACY_PICKLES):
        *_, (_, _, stop) = pickletools.genops(rest)
        end = (stop or 0) + 1
        parts.append(rest[:end])
        rest = rest[end:]
    at = random.choice((0, 1, 2, 3, 3, 3, 4, 4, 5, 5))
    if at == _LEGACY_PICKLES:
        rest = _lengthened(random, rest) if random.random() < 0.5 else damaged(random, rest, other)
    else:
        parts[at] = respelt(random, opcodes_of(parts[at]), opcodes_of(parts[3]))
    return b"".join(parts) + rest


def _lengthened(random: Random, storages: bytes) -> bytes:
    """The first storage with another length before it, sometimes with as much data."""
    count = random.choice((*NUMBERS, int.from_bytes(storages[:8], "little") + 1))
    more = bytes(4) if random.random() < 0.5 else b""
    return little(count, 8) + more + storages[8:]


def spoilt_arrays(random: Random, file: bytes, other: bytes) -> bytes:
    """A .npz with one array's header or numbers changed, dropped or doubled, packed again in either way."""
    if random.random() < 0.3:
        return spoilt(random, file, other)
    with zipfile.ZipFile(io.BytesIO(file)) as archive:
        entries = [(name, archive.read(name)) for name in archive.namelist()]
    at = random.randrange(len(entries))
    name, data = entries[at]
    match random.randrange(6):
        case 0:
            del entries[at]
        case 1:
            entries.append((random.choice(("values.npy", "tsdf.npy", "x.npy", "x")), data))
        case 2:
            entries[at] = (name, data[:128] + damaged(random, data[128:]))
        case _:
            entries[at] = (name, _reheaded(random, data))
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", random.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
        for key, value in entries:
            archive.writestr(zipfile.ZipInfo(key), value, archive.compression)
    return buffer.getvalue()


def _reheaded(random: Random, array: bytes) -> bytes:
    """An array with other words in its header, whose length is mostly told as it is."""
    length = int.from_bytes(array[8:10], "little")
    text = reworded(random, array[10 : 10 + length], _WORDS)
    told = random.choice(NUMBERS) if random.random() < 0.1 else len(text)
    return array[:8] + little(told, 2) + text + array[10 + length :]


def spoilt_mesh(random: Random, file: bytes, other: bytes) -> bytes:
    """A mesh with other words, other JSON, or other numbers; lengths are mostly told as they are."""
    if random.random() < 0.15:
        return damaged(random, file, other)
    if file.startswith(b"glTF"):
        return _spoilt_glb(random, file, other)
    header, end, body = file.partition(_HEADER_END)
    if file.startswith(b"ply") and b"ascii" not in header:
        if random.random() < 0.6:
            return reworded(random, header + end, _WORDS) + body
        return header + end + damaged(random, body)
    if not _is_text(file):  # a binary stl: a count, then triangles
        return file[:80] + (damaged(random, file[80:]) if random.random() < 0.7 else number(random, 4) + file[84:])
    return reworded(random, file, _WORDS)


def _is_text(file: bytes) -> bool:
    return file.isascii() and b"\0" not in file


def _spoilt_glb(random: Random, file: bytes, other: bytes) -> bytes:
    length = int.from_bytes(file[12:16], "little")
    document, rest = json.loads(file[20 : 20 + length]), file[20 + length :]
    if random.random() < 0.2:
        rest = damaged(random, rest, other)
    else:
        for _ in range(random.choice((1, 1, 2, 3))):
            document = altered(random, document, most_depth=8)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = b"glTF" + little(2, 4) + little(20 + len(text) + len(rest), 4) + little(len(text), 4) + b"JSON"
    return (damaged(random, head) if random.random() < 0.05 else head) + text + rest


def spoilt_model(random: Random, file: bytes, other: bytes) -> bytes:
    """An ONNX model whose protocol buffer is changed field by field."""
    return damaged(random, file, other) if random.random() < 0.1 else rewired(random, file)


def spoilt_database(random: Random, file: bytes, other: bytes) -> bytes:
    """A SQLite file after a few statements, or with damaged pages, or both."""
    if random.random() < 0.3:
        return _as_long(damaged(random, file, other), file)
    connection = sqlite3.connect(":memory:", isolation_level=None)
    try:
        connection.deserialize(file)
        for _ in range(random.choice((1, 1, 2, 3))):
            _execute_any(random, connection)
        changed: bytes = connection.serialize()
    finally:
        connection.close()
    return _as_long(damaged(random, changed, other), changed) if random.random() < 0.2 else changed


def _as_long(changed: bytes, file: bytes) -> bytes:
    """Cut or filled up: a size that is not whole pages is the first thing to be refused."""
    return changed[: len(file)].ljust(len(file), b"\0")


def _execute_any(random: Random, connection: sqlite3.Connection) -> None:
    tables = [name for (name,) in connection.execute("SELECT name FROM sqlite_schema WHERE type = 'table'")]
    table = random.choice(sorted(tables))
    columns = [row[1] for row in connection.execute(f"PRAGMA table_info({table})")]
    statement = random.choice(_STATEMENTS)
    value = random.choice(_VALUES).format(random=random.randrange(1 << 40))
    if value == _BLOB:
        value = f"x'{random.randbytes(4096).hex()}'"
    try:
        connection.execute(statement.format(table=table, column=random.choice(columns), value=value))
    except sqlite3.Error:
        return  # not every statement suits every table, above all after others


SPOILERS: dict[str, Callable[[Random, bytes, bytes], bytes]] = {
    "legacy": spoilt_legacy,
    "arrays": spoilt_arrays,
    "database": spoilt_database,
    "mesh": spoilt_mesh,
    "onnx": spoilt_model,
    "other": spoilt,
    "run": spoilt_run,
    "settings": spoilt_settings,
}
"""What damages the files of each stage that is named after a container."""
