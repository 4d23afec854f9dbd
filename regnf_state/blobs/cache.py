"""Copies of remote files on this machine, shared by its processes and kept below a size.

A process that uses a file holds a shared lock on it. To make room, only files without a lock are deleted, the least
recently used first. A file gets its name by a link when it is complete, so readers never see a part of one.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from hashlib import sha256
from pathlib import Path
from typing import BinaryIO
from uuid import uuid4

_UNFINISHED = ".part"


class FileCache:
    """Files below ``folder``, at most ``max_bytes`` of them beside those in use."""

    def __init__(self, folder: Path, max_bytes: int) -> None:
        self._folder = folder
        self._max_bytes = max_bytes

    @contextmanager
    def held(self, name: str, fetch: Callable[[BinaryIO], None]) -> Iterator[Path]:
        """The file called ``name``, fetched if it is not here, for as long as the block lasts."""
        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        path = self._folder / sha256(name.encode()).hexdigest()
        while (file := _locked(path)) is None:
            self._fetch(path, fetch)
        with file:
            os.utime(path)
            self._make_room()
            yield path

    def _fetch(self, path: Path, fetch: Callable[[BinaryIO], None]) -> None:
        temporary = self._folder / f"{uuid4().hex}{_UNFINISHED}"
        try:
            with temporary.open("xb") as file:
                fcntl.flock(file, fcntl.LOCK_EX)
                fetch(file)
                file.flush()
                # another process was faster, and its file may be in use; or one making room saw this one unlocked
                with suppress(FileExistsError, FileNotFoundError):
                    os.link(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)

    def _make_room(self) -> None:
        found = []
        for path in self._folder.iterdir():
            with suppress(FileNotFoundError):
                found.append((path.stat(), path))
        total = sum(status.st_size for status, _ in found)
        for status, path in sorted(found, key=lambda one: one[0].st_mtime_ns):
            if path.suffix != _UNFINISHED and total <= self._max_bytes:
                continue
            if _removed(path):
                total -= status.st_size


def _locked(path: Path) -> BinaryIO | None:
    """The file, open and locked against removal; None when it is not, or no longer, there."""
    try:
        file = path.open("rb")
    except FileNotFoundError:
        return None
    fcntl.flock(file, fcntl.LOCK_SH)
    with suppress(FileNotFoundError):
        if os.path.samestat(os.fstat(file.fileno()), path.stat()):
            return file
    file.close()
    return None


def _removed(path: Path) -> bool:
    with suppress(FileNotFoundError, BlockingIOError), path.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        path.unlink()
        return True
    return False
