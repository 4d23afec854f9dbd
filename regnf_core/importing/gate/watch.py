"""What the parent sees of a child while it runs: limits that the kernel has for a file or a user, not a child."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

MAX_THREADS = 64
_MAX_ENTRIES = 64
_BLOCK = 512

Trespass = Literal["threads", "output"]


@dataclass(frozen=True)
class Watch:
    """A look at one child: how many threads it has, and how much lies in its folder."""

    folder: Path
    folder_bytes: int

    def look(self, pid: int) -> Trespass | None:
        """Which limit the child is beyond, if any."""
        if _threads(pid) > MAX_THREADS:
            return "threads"
        return "output" if self._too_much_output() else None

    def _too_much_output(self) -> bool:
        total = 0
        with suppress(FileNotFoundError), os.scandir(self.folder) as entries:  # a file may just be renamed
            for count, entry in enumerate(entries):
                total += entry.stat(follow_symlinks=False).st_blocks * _BLOCK
                if count >= _MAX_ENTRIES or total > self.folder_bytes:
                    return True
        return False


def _threads(pid: int) -> int:
    """Threads of the process, 0 where the system does not tell."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0
    return int(fields[17])
