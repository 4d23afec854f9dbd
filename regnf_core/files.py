"""Files that appear complete or not at all, and the names that they may have."""

from __future__ import annotations

import errno
import os
import secrets
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from regnf_core.errors import InvalidInputError, InvalidOptionsError

RECORDING_SUFFIX = ".rrd"
"""Of recordings for the viewer of rerun."""


@contextmanager
def atomic_path(path: str | os.PathLike[str], durable: bool = False) -> Iterator[Path]:
    """A path beside ``path`` to write to. It is renamed to ``path`` at the end, or removed after an error.

    durable: the content is on the disk before the rename, so that a power failure leaves no incomplete file either.
    """
    target = Path(path)
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(8)}.part")
    try:
        yield temporary
        if durable:
            _flush_to_disk(temporary)
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def made_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """The folder, made with those above it if need be. After an error the made ones go again, if they are empty."""
    folder = Path(path)
    missing = [one for one in (folder, *folder.parents) if not one.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield folder
    except BaseException:
        for one in missing:
            with suppress(OSError):
                one.rmdir()
        raise


@contextmanager
def filled_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A folder to write files into, which lie in the folder ``path`` at the end. After an error none of them does."""
    with made_folder(path) as target, tempfile.TemporaryDirectory(dir=target) as work:
        yield Path(work)
        for made in sorted(Path(work).iterdir()):
            made.replace(target / made.name)


def require_writable(folder: str | os.PathLike[str]) -> None:
    """Raises PermissionError unless the folder may be written into, or made. Nothing is made."""
    place = next(one for one in (Path(folder).absolute(), *Path(folder).absolute().parents) if one.exists())
    if not os.access(place, os.W_OK | os.X_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(folder))


def new_file(path: str | os.PathLike[str], suffix: str) -> Path:
    """The path of a file to write, whose name ends in ``suffix``.

    Raises InvalidOptionsError for another name, InvalidInputError (FILE_IS_FOLDER) where there is a folder.
    """
    target = Path(path)
    if target.is_dir():
        hint = f"Name a file in it: {target / 'result'}{suffix}"
        raise InvalidInputError(f"{target}: a folder, expected a file to write", reason="FILE_IS_FOLDER", hint=hint)
    if target.suffix != suffix:
        raise InvalidOptionsError(f"{target}: expected a name that ends in {suffix}")
    return target


def _flush_to_disk(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
