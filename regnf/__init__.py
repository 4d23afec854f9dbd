"""regnf: find the pose of a known object in a scanned room, with neural signed distance fields.

    import regnf

    box = regnf.OrientedBox.from_corners([-0.84, -0.59, -0.50], [-0.29, 0.02, 0.02])
    result = regnf.register("room.ckpt", "chair.glb", box)
    print(result.verdict, result.scale)

This process does the work; with ``regnf.Client`` a service does it. Names are resolved on first use, so a program that
uses only the client does not load torch.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

import regnf_core
from regnf_core.version import __version__ as __version__

if TYPE_CHECKING:
    from regnf.fitting import fit, fuse
    from regnf.recordings import Frame
    from regnf.recordings import register as register
    from regnf.recordings import register_batch as register_batch
    from regnf.recordings import search as search
    from regnf_client import AsyncClient, Client, Pair, PairResult
    from regnf_core import *  # type: ignore[assignment]  # noqa: F403 - every other name that it lists

_HOMES = {
    "AsyncClient": "regnf_client",
    "Client": "regnf_client",
    "Pair": "regnf_client",
    "PairResult": "regnf_client",
    **dict.fromkeys(("fit", "fuse"), "regnf.fitting"),
    **dict.fromkeys(("Frame", "register", "register_batch", "search"), "regnf.recordings"),
}
"""All other names are those of regnf_core."""

__all__ = ["AsyncClient", "Client", "Frame", "Pair", "PairResult", "fit", "fuse"]
__all__ += regnf_core.__all__


def __getattr__(name: str) -> object:
    if name in __all__:
        return getattr(importlib.import_module(_HOMES.get(name, "regnf_core")), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
