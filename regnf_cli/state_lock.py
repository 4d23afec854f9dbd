"""One service for each state folder."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

from regnf_cli.start_errors import StartError

_NAME = "serve.lock"
_SOCKET_PREFIX = "regnf-"


class StateLock:
    """Holds a state folder for one service, and records what the next one must remove if this one is killed.

    Raises StartError (STATE_DIR_IN_USE, STATE_DIR_UNUSABLE) on entry.
    """

    def __init__(self, state_dir: Path) -> None:
        self._state_dir = state_dir
        self._noted: dict[str, object] = {}
        self.socket_dir: Path | None = None

    def __enter__(self) -> StateLock:
        try:
            self._state_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
            self._file = (self._state_dir / _NAME).open("a+")
        except OSError as error:
            detail = f"cannot keep state in {self._state_dir}: {error.strerror}"
            hint = "Give a folder that can be written with --state-dir."
            raise StartError(detail, reason="STATE_DIR_UNUSABLE", hint=hint) from error
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            held = self._read()
            self._file.close()
            who = f" (process {held['pid']}, {held.get('address', 'not listening yet')})" if "pid" in held else ""
            detail = f"another `regnf serve`{who} uses {self._state_dir}"
            hint = "Use that one, or stop it, or give this one its own folder with --state-dir."
            raise StartError(detail, reason="STATE_DIR_IN_USE", hint=hint) from error
        self._remove_leftover()
        self.note(pid=os.getpid())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.socket_dir is not None:
            shutil.rmtree(self.socket_dir, ignore_errors=True)
        self._write({})
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
