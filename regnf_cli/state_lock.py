"""One service for each state folder."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import shutil
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType

from regnf_cli.start_errors import StartError

_NAME = "serve.lock"
_SOCKET_PREFIX = "regnf-"
_LEAST_FREE_BYTES = 1 << 20
"""What Redis and the storage write when they start takes some kilobytes."""


class StateLock:
    """Holds a state folder for one service, and records what the next one must remove if this one is killed.

    Raises StartError (STATE_DIR_IN_USE, STATE_DIR_UNUSABLE) on entry.
    """

    def __init__(self, state_dir: Path) -> None:
        self._state_dir = state_dir
        self._noted: dict[str, object] = {}
        self.socket_dir: Path | None = None

    def __enter__(self) -> StateLock:
        made = [folder for folder in (self._state_dir, *self._state_dir.parents) if not folder.exists()]
        try:
            self._state_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
            self._lock()
            _require_writable(self._state_dir)
            self._remove_leftover()
            self.note(pid=os.getpid())
        except OSError as error:
            with suppress(AttributeError, OSError):  # it may not have come to be
                self._file.close()
            _take_back(made)
            detail = f"cannot keep state in {self._state_dir}: {error.strerror}"
            if error.filename is not None and Path(error.filename).is_relative_to(self._state_dir):
                detail = f"cannot keep state in {error.filename}: {error.strerror}"
            hint = "Give a folder that can be written with --state-dir."
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                hint = "Make room on the disk, or give a folder on another one with --state-dir."
            raise StartError(detail, reason="STATE_DIR_UNUSABLE", hint=hint) from error
        return self

    def _lock(self) -> None:
        """Raises OSError, StartError (STATE_DIR_IN_USE)."""
        self._file = (self._state_dir / _NAME).open("a+")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            held = self._read()
            self._file.close()
            who = f" (process {held['pid']}, {held.get('address', 'not listening yet')})" if "pid" in held else ""
            detail = f"another `regnf serve`{who} uses {self._state_dir}"
            hint = "Use that one, or stop it, or give this one its own folder with --state-dir."
            raise StartError(detail, reason="STATE_DIR_IN_USE", hint=hint) from error

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.socket_dir is not None:
            shutil.rmtree(self.socket_dir, ignore_errors=True)
        with suppress(OSError):  # on a full disk the note stays: the lock itself is what counts
            self._write({})
        with suppress(OSError):
            self._file.close()

    def make_socket_dir(self) -> Path:
        """A private folder with a short path: socket paths hold about a hundred bytes, state folders may lie deep."""
        usual = tempfile.gettempdir()
        folder = Path(tempfile.mkdtemp(prefix=_SOCKET_PREFIX, dir=usual if len(usual) < 60 else "/tmp"))  # noqa: S108
        self.socket_dir = folder
        self.note(socket_dir=str(folder))
        return folder

    def note(self, **more: object) -> None:
        """Record more of this service: process, address, the folder of its socket."""
        self._noted |= more
        self._write(self._noted)

    def _write(self, content: Mapping[str, object]) -> None:
        self._file.seek(0)
        self._file.truncate()
        json.dump(content, self._file)
        self._file.flush()

    def _read(self) -> dict[str, object]:
        self._file.seek(0)
        try:
            content = json.loads(self._file.read() or "{}")
        except ValueError:
            return {}
        return content if isinstance(content, dict) else {}

    def _remove_leftover(self) -> None:
        left = Path(str(self._read().get("socket_dir", "")))
        if left.name.startswith(_SOCKET_PREFIX) and left.is_dir() and left.stat().st_uid == os.getuid():
            shutil.rmtree(left, ignore_errors=True)


def _require_writable(state_dir: Path) -> None:
    """Raises OSError for a folder of the service's, one within it, or a disk, that takes no more files."""
    inside = [folder for pattern in ("*/", "*/*/") for folder in state_dir.glob(pattern)]
    for folder in (state_dir, *inside):
        try:
            with tempfile.TemporaryFile(dir=folder) as file:
                if folder == state_dir:
                    os.posix_fallocate(file.fileno(), 0, _LEAST_FREE_BYTES)
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(folder)) from error


def _take_back(made: list[Path]) -> None:
    """Remove the folders that a start has made, the innermost first, and nothing else."""
    with suppress(OSError):
        if made:
            (made[0] / _NAME).unlink(missing_ok=True)
        for folder in made:
            folder.rmdir()
