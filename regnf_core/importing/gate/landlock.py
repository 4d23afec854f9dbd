"""Landlock, by its three system calls: this process may read a few places, write to one folder, and nothing else.

The kernel holds to it for the rest of the process's life (Linux 5.13 and later, where the module is switched on).
Beyond files it forbids what its version knows of: TCP, other processes' abstract sockets, signals to them, and looking
into them (/proc/<pid>/environ, /proc/<pid>/mem). The owner, the mode and the times of a file are not its concern.
"""

from __future__ import annotations

import ctypes
import os
import struct
from collections.abc import Iterable
from pathlib import Path

_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446  # the same on every architecture
_VERSION_FLAG, _PATH_BENEATH = 1, 1
_WRITE_FILE, _READ_FILE, _READ_DIR, _REMOVE_FILE, _MAKE_REGULAR, _TRUNCATE = (
    1 << 1,
    1 << 2,
    1 << 3,
    1 << 5,
    1 << 8,
    1 << 14,
)
_FILE_RIGHTS = {1: (1 << 13) - 1, 2: (1 << 14) - 1, 3: (1 << 15) - 1, 5: (1 << 16) - 1}
"""All rights of a version and those after it: naming a right is what forbids it."""
_NET_RIGHTS, _NET_SINCE = 0b11, 4
_SCOPES, _SCOPES_SINCE = 0b11, 6
_OF_FILES = _READ_FILE | _WRITE_FILE | _TRUNCATE
"""The rights that may be given to what is not a folder."""
_READ = _READ_FILE | _READ_DIR
_OWN = _READ | _WRITE_FILE | _REMOVE_FILE | _MAKE_REGULAR | _TRUNCATE

Place = int | Path
"""An open file descriptor, or a path."""


def restrict_files(readable: Iterable[Place], folder: Path) -> bool:
    """From now on this process reads ``readable``, and what lies below, and works in ``folder``; all else is refused.

    Returns False, having changed nothing, where the kernel has no Landlock. Needs no_new_privs to be set, and to be
    called before there are other threads.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    version = libc.syscall(_CREATE_RULESET, None, 0, _VERSION_FLAG)
    if version < 1:
        return False
    handled = _FILE_RIGHTS[max(known for known in _FILE_RIGHTS if known <= version)]
    net, scopes = _NET_RIGHTS * (version >= _NET_SINCE), _SCOPES * (version >= _SCOPES_SINCE)
    ruleset = libc.syscall(_CREATE_RULESET, struct.pack("=QQQ", handled, net, scopes), 24, 0)
    if ruleset < 0:
        return False
    try:
        for place in readable:
            _allow(libc, ruleset, place, _READ & handled)
        _allow(libc, ruleset, folder, _OWN & handled)
        return bool(libc.syscall(_RESTRICT_SELF, ruleset, 0) == 0)
    finally:
        os.close(ruleset)


def _allow(libc: ctypes.CDLL, ruleset: int, place: Place, rights: int) -> None:
    """Give the rights to the place and all below it. What cannot be opened needs no rule."""
    try:
        opened = place if isinstance(place, int) else os.open(place, os.O_PATH | os.O_CLOEXEC)
    except OSError:
        return
    try:
        if not os.path.isdir(opened):
            rights &= _OF_FILES
        if libc.syscall(_ADD_RULE, ruleset, _PATH_BENEATH, struct.pack("=Qi", rights, opened), 0) != 0:
            raise OSError(ctypes.get_errno(), "a Landlock rule was refused")
    finally:
        if not isinstance(place, int):
            os.close(opened)
