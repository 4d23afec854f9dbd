"""Loading the engine into the worker's own process, once, so that its children find it there: REGNF_PRELOAD.

A child of a process that has threads may hang: of a pool of threads, a fork copies the locks and not the threads. So
nothing is run here, only imported. torch starts its threads with its first operation, CUDA its context with the first
call, and both happen in children only; OpenBLAS, numpy's, starts its threads as it is loaded and is therefore told to
have none, here and in the children.
"""

from __future__ import annotations

import gc
import os
from importlib import import_module
from pathlib import Path

_MODULES = (
    "regnf_worker.engine",
    "regnf_worker.attempt",
    "regnf_core.geometry.box",
    "regnf_core.viewing",
    "regnf_core.fields.build",
    "regnf_core.library",
    "regnf_core.registration",
    "regnf_core.rendering.job",
    "regnf_core.geometry.sim3",
    "PIL.PngImagePlugin",
)
"""What regnf_worker.engine imports where it needs it, and what Pillow does."""


class PreloadError(RuntimeError):
    """Something that was loaded has started threads: children could hang."""

    reason = "PRELOAD_THREADS"


def preload() -> None:
    """Import what registrations need. Raises PreloadError if the process has several threads afterwards (Linux)."""
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    for name in _MODULES:
        import_module(name)
    tasks = Path("/proc/self/task")
    if tasks.exists() and len(list(tasks.iterdir())) > 1:
        raise PreloadError("a library that was loaded has started threads; unset REGNF_PRELOAD")
    gc.freeze()  # a collection in a child would otherwise copy the pages of everything that was loaded
