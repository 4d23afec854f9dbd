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
        self._left: list[Path] = []

    def of_job(self) -> Path:
        """The name of a folder for one job; ``make`` makes it."""
        return self.folder / f"job-{uuid4().hex}"

    @staticmethod
    def make(folder: Path) -> None:
        """Make a job's folder. Raises OSError: the disk is full, or the volume away."""
        folder.mkdir(mode=0o700)

    def drop(self, folder: Path) -> None:
        """Delete whatever a job has left. What cannot be deleted now goes with ``drop_left``."""
        try:
            shutil.rmtree(folder)
        except FileNotFoundError:
            if not self.folder.exists():  # the volume is away, and comes back with what is on it
                self._left.append(folder)
        except OSError as error:
            logger.warning("temporary files stay for now: %s", error)
            self._left.append(folder)

    def drop_left(self) -> bool:
        """Delete what could not be deleted before, once the folder is there: whether anything is left."""
        if self._left and self.folder.exists():
            left, self._left = self._left, []
            for folder in left:
                shutil.rmtree(folder, ignore_errors=True)
                self._left += [folder] if folder.exists() else []
        return bool(self._left)

    @staticmethod
    def use(folder: Path) -> None:
        """Have this process' temporary files made here."""
        import tempfile

        os.environ["TMPDIR"] = str(folder)
        tempfile.tempdir = str(folder)

    def remove(self) -> None:
        """The worker ends."""
        shutil.rmtree(self.folder, ignore_errors=True)
        self._lock.close()


def _remove_if_dead(folder: Path) -> None:
    with suppress(BlockingIOError, FileNotFoundError), (folder / _LOCK).open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        shutil.rmtree(folder, ignore_errors=True)
