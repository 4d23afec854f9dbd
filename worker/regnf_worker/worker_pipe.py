"""The pipe between a job's process and its worker: closed, the process has ended; a byte, the worker may go on.

A process says so once its result is out. What it still does, the worker lets it do beside the next job.
"""

from __future__ import annotations

import os

_writing: list[int] = []
"""The end that this process holds, if it is a job's."""


def hold(writing: int) -> None:
    """This process is a job's; its worker reads the other end."""
    _writing.append(writing)


def let_worker_go() -> bool:
    """Tell the worker that it need not wait for this process. False where this process is no job's, as in tests."""
    for pipe in _writing:
        os.write(pipe, b".")
    return bool(_writing)
