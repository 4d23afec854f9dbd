"""Where an archive's members go as they are unpacked: small ones into memory, large ones into a file that is mapped."""

from __future__ import annotations

import itertools
import mmap
from collections.abc import Iterable, Iterator
from pathlib import Path

from regnf_core.errors import FieldFormatError

MAX_NAME_BYTES, MAX_PARTS = 512, 32
FREE_BYTES = 64 << 20
"""What an archive may unpack to without anybody looking at how tightly it was packed."""
MAX_RATIO = 200
"""Beyond that, bytes unpacked for a byte packed. Checkpoints of trained fields stay below 10."""
_IN_MEMORY = 1 << 20


def archive_error(message: str, reason: str = "ARCHIVE_MALFORMED") -> FieldFormatError:
    """The error for an archive of a run that is not taken."""
    return FieldFormatError(message, reason=reason)


def require_modest(unpacked: int, packed: int, most: int) -> None:
    """Raise FieldFormatError (ARCHIVE_TOO_LARGE) for what unpacks to more than ``most`` bytes, or to many from few."""
    if unpacked > most:
        raise archive_error(f"the archive unpacks to more than {most} bytes", "ARCHIVE_TOO_LARGE")
    if unpacked > FREE_BYTES + MAX_RATIO * packed:
        raise archive_error(f"the archive unpacks to more than {MAX_RATIO} times its size", "ARCHIVE_TOO_LARGE")


def kept(pieces: Iterable[bytes | memoryview], size: int, folder: Path) -> memoryview:
    """The pieces, ``size`` bytes in all, in one. A large one lies in a new file in ``folder`` until that is removed."""
    if size <= _IN_MEMORY:
        return memoryview(b"".join(pieces))
    with open(new_file(folder), "x+b") as file:
        for piece in pieces:
            file.write(piece)
        file.flush()
        return memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))


def new_file(folder: Path) -> Path:
    """Where the next part of an archive may be written."""
    return next(path for path in _places(folder) if not path.exists())


def remove_unpacked(folder: Path) -> None:
    """Remove the files that were written to ``new_file``. What is mapped stays readable."""
    for path in _places(folder):
        if not path.exists():
            return
        path.unlink()


def _places(folder: Path) -> Iterator[Path]:
    return (folder / f"unpacked-{number}" for number in itertools.count())
