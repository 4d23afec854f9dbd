"""A folder for temporary files that is gone when its worker is, however the worker ends."""

from __future__ import annotations

import fcntl
import logging
import os
import shutil
from contextlib import suppress
from pathlib import Path
from uuid import uuid4

_LOCK = ".lock"
logger = logging.getLogger(__name__)


class Scratch:
    """One worker's folder below ``parent``. Making one sweeps away the folders whose workers have died."""

    def __init__(self, parent: Path) -> None:
        parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with (parent / _LOCK).open("a") as gate:
            fcntl.flock(gate, fcntl.LOCK_EX)  # no other process sweeps while a folder exists that is not yet locked
            for left in parent.iterdir():
                if left.is_dir():
                    _remove_if_dead(left)
            self.folder = parent / uuid4().hex
            self.folder.mkdir(mode=0o700)
            self._lock = (self.folder / _LOCK).open("a")
            fcntl.flock(self._lock, fcntl.LOCK_EX)

    def empty(self) -> None:
        """Delete whatever a job has left. What cannot be deleted now goes when the next worker starts."""
        try:
            self._empty()
        except OSError as error:
            logger.warning("temporary files stay for now: %s", error)

    def _empty(self) -> None:
        for entry in self.folder.iterdir():
            if entry.name == _LOCK:
                continue
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry, ignore_errors=True)
            else:
                entry.unlink(missing_ok=True)

    def use(self) -> None:
        """Have this process' temporary files made here."""
        import tempfile

        os.environ["TMPDIR"] = str(self.folder)
        tempfile.tempdir = str(self.folder)

    def remove(self) -> None:
        """The worker ends."""
        shutil.rmtree(self.folder, ignore_errors=True)
        self._lock.close()


def _remove_if_dead(folder: Path) -> None:
    with suppress(BlockingIOError, FileNotFoundError), (folder / _LOCK).open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        shutil.rmtree(folder, ignore_errors=True)
