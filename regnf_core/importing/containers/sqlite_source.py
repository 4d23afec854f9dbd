"""A SQLite file from an untrusted source: from memory, read-only, tables alone, no functions, and counted.

SQLite's own advice for such files is followed: the schema is not trusted, limits are low, an authorizer refuses all but
reading, and statements end after so much work. It runs in the gate's throw-away process like everything else. The file
itself is never opened by SQLite: it gets a copy of the bytes, so there is no journal, no lock and no second file.
"""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Iterator
from typing import Any

from regnf_core.errors import FieldFormatError

MAX_DATABASE_BYTES = 1 << 30
_MAGIC = b"SQLite format 3\x00"
_HEADER_BYTES = 100
_MAX_TABLES = 64
_MAX_VALUE_BYTES = 1 << 20
_WORK_STEP, _MAX_WORK_STEPS = 100_000, 10_000
"""Virtual machine instructions between two looks, and how many looks: a thousand million instructions in all."""
_FAULTS = (sqlite3.Error, UnicodeError)
"""The second where SQLite's own words on a fault quote bytes that are not text."""
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,63}")
_PLAIN_STATEMENTS = {"table": ("CREATE TABLE",), "index": ("CREATE INDEX", "CREATE UNIQUE INDEX")}
_COMPUTED = -2
"""In place of a column's number, in SQLite's list of an index's columns."""
_LIMITS = {
    sqlite3.SQLITE_LIMIT_LENGTH: _MAX_VALUE_BYTES,
    sqlite3.SQLITE_LIMIT_SQL_LENGTH: 10_000,
    sqlite3.SQLITE_LIMIT_COLUMN: 64,
    sqlite3.SQLITE_LIMIT_EXPR_DEPTH: 16,
    sqlite3.SQLITE_LIMIT_COMPOUND_SELECT: 2,
    sqlite3.SQLITE_LIMIT_VDBE_OP: 25_000,
    sqlite3.SQLITE_LIMIT_FUNCTION_ARG: 4,
    sqlite3.SQLITE_LIMIT_ATTACHED: 0,
    sqlite3.SQLITE_LIMIT_LIKE_PATTERN_LENGTH: 50,
    sqlite3.SQLITE_LIMIT_VARIABLE_NUMBER: 10,
    sqlite3.SQLITE_LIMIT_TRIGGER_DEPTH: 1,
    sqlite3.SQLITE_LIMIT_WORKER_THREADS: 0,
}


_OTHERS = (
    (
        {"Node", "Link", "Data"},
        "an RTAB-Map database; give its cloud or mesh (rtabmap-export --cloud, --mesh), or its depth images and poses "
        "(rtabmap-export --images --poses) as a recording",
    ),
    ({"topics", "messages"}, "a recording of a robot; upload it with POST /recordings"),
    ({"cameras", "images", "keypoints"}, "a COLMAP database, which has no surface; give the fused cloud or the mesh"),
)
"""Databases of other programs, by tables that they have."""


class TableSource:
    """The plain tables of a SQLite file.

    Raises FieldFormatError: TENSOR_TOO_LARGE, FILE_TRUNCATED, SQLITE_MALFORMED, SQLITE_NOT_PLAIN, FAMILY_NOT_SUPPORTED.
    """

    def __init__(self, data: memoryview) -> None:
        _check_header(data)
        self._work = _MAX_WORK_STEPS
        self._connection = sqlite3.connect(":memory:", isolation_level=None)
        self._connection.text_factory = lambda raw: raw.decode("utf-8", "replace")
        for limit, value in _LIMITS.items():
            self._connection.setlimit(limit, value)
        try:
            self._connection.deserialize(data)
            for setting in ("trusted_schema = OFF", "cell_size_check = ON", "query_only = ON", "temp_store = MEMORY"):
                self._connection.execute(f"PRAGMA {setting}")
            self._connection.set_authorizer(_allow_reading)
            self._connection.set_progress_handler(self._too_much_work, _WORK_STEP)
            self.tables = self._read_schema()
            for table in sorted(self.tables):
                self._require_plain(table)
        except _FAULTS as error:
            self.close()
            raise _malformed(error) from error
        except FieldFormatError:
            self.close()
            raise

    def close(self) -> None:
        """Let go of the copy."""
        self._connection.close()

    def rows(self, table: str, columns: tuple[str, ...], most: int) -> Iterator[tuple[Any, ...]]:
        """Rows of one of ``tables``. Raises FieldFormatError: TENSOR_MISSING, TENSOR_TOO_LARGE or SQLITE_MALFORMED."""
        if table not in self.tables or not all(_NAME.fullmatch(column) for column in columns):
            raise FieldFormatError(f"there is no table {table[:80]}", reason="TENSOR_MISSING")
        try:
            found = self._connection.execute(f'SELECT {", ".join(columns)} FROM "{table}"')  # noqa: S608 (names are checked)
            for count, row in enumerate(found):
                if count >= most:
                    raise FieldFormatError(f"{table} has more than {most} rows", reason="TENSOR_TOO_LARGE")
                yield row
        except _FAULTS as error:
            raise _malformed(error) from error

    def _read_schema(self) -> frozenset[str]:
        """The tables' names: each entry makes a table or an index of one, by what it says and by what it is."""
        tables = set()
        names = {row[0] for row in self._connection.execute("SELECT name FROM sqlite_master LIMIT 1000")}
        for known, what in _OTHERS:
            if known <= names:
                raise FieldFormatError(what, reason="FAMILY_NOT_SUPPORTED")
        for count, (kind, name, statement) in enumerate(
            self._connection.execute("SELECT type, name, sql FROM sqlite_master")
        ):
            made = _PLAIN_STATEMENTS.get(kind, ()) if isinstance(kind, str) else ()
            text = statement.upper() if isinstance(statement, str) else ""
            own_index = kind == "index" and statement is None  # of a key; SQLite makes it
            if count >= _MAX_TABLES or not (own_index or text.startswith(made or ("-",))):
                raise _not_plain(f"a {str(kind)[:20]}, or too many tables")
            if kind == "table" and isinstance(name, str) and _NAME.fullmatch(name):
                tables.add(name)
        return frozenset(tables)

    def _require_plain(self, table: str) -> None:
        """Nothing of the table is computed, however that is spelled: no column, and no entry or condition of an index.

        Raises FieldFormatError (SQLITE_NOT_PLAIN).
        """
        hidden = [row[6] for row in self._connection.execute(f'PRAGMA table_xinfo("{table}")')]
        if any(hidden):
            raise _not_plain("a computed column")
        for _, name, _, _, partial in self._connection.execute(f'PRAGMA index_list("{table}")').fetchall():
            quoted = str(name).replace('"', '""')
            columns = [row[1] for row in self._connection.execute(f'PRAGMA index_xinfo("{quoted}")')]
            if partial or _COMPUTED in columns:
                raise _not_plain("an index of a computed expression")

    def _too_much_work(self) -> bool:
        self._work -= 1
        return self._work < 0


def _check_header(data: memoryview) -> None:
    """The size is whole pages, all of them here; nothing is left in a write-ahead log beside the file."""
    if len(data) > MAX_DATABASE_BYTES:
        raise FieldFormatError(f"a database of more than {MAX_DATABASE_BYTES} bytes", reason="TENSOR_TOO_LARGE")
    if len(data) < _HEADER_BYTES:
        raise FieldFormatError("the database ends within its header", reason="FILE_TRUNCATED")
    page = int.from_bytes(data[16:18], "big")
    page = 65536 if page == 1 else page
    if bytes(data[:16]) != _MAGIC or page < 512 or page & (page - 1):
        raise _malformed("the header is malformed")
    if data[18] != 1 or data[19] != 1:
        raise _malformed("part of it may be in a write-ahead log; set PRAGMA journal_mode = DELETE, and save it again")
    pages = int.from_bytes(data[28:32], "big")
    if len(data) % page or pages > len(data) // page:
        raise FieldFormatError("the database is truncated", reason="FILE_TRUNCATED")


def _allow_reading(action: int, first: str | None, *_: str | None) -> int:
    allowed = action in (sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ)
    looking = action == sqlite3.SQLITE_PRAGMA and first in ("table_xinfo", "index_list", "index_xinfo")
    return sqlite3.SQLITE_OK if allowed or looking else sqlite3.SQLITE_DENY


def _not_plain(what: str) -> FieldFormatError:
    return FieldFormatError(f"the file has more than plain tables: {what}", reason="SQLITE_NOT_PLAIN")


def _malformed(cause: object) -> FieldFormatError:
    return FieldFormatError(f"the database cannot be read: {cause}", reason="SQLITE_MALFORMED")
