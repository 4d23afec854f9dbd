"""regnf_core: registration of neural signed distance fields.

    from regnf_core import OrientedBox, register

    box = OrientedBox.from_corners([-0.4, -0.3, 0.0], [0.1, 0.2, 0.4])
    result = register("outputs/room/neus/run/", "chair.ply", box)
    result.T_scene_object.matrix()   # (4, 4): the object's pose in the scene

Names are resolved on first use, so that importing a torch-free part (options, errors) does not load torch.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from regnf_core.version import __version__

if TYPE_CHECKING:
    from regnf_core.api import BatchOutcome, Registered, Search, compose, register, register_batch, render, search
    from regnf_core.document import RegistrationResult
    from regnf_core.editing.edits import Insertion, Removal, Replacement, Substitution
    from regnf_core.errors import RegnfError
    from regnf_core.fields.observation import SdfField
    from regnf_core.geometry.box import OrientedBox
    from regnf_core.geometry.sim3 import Sim3
    from regnf_core.in_memory import FieldWarning, from_function, from_grid, from_mesh, from_points
    from regnf_core.loading import open_field
    from regnf_core.options import RegistrationOptions
    from regnf_core.rendering.camera import Camera
    from regnf_core.rendering.request import RenderOptions
    from regnf_core.robust.pipeline import WarmStart

_HOMES = {
    "BatchOutcome": "regnf_core.api",
    "Camera": "regnf_core.rendering.camera",
    "FieldWarning": "regnf_core.in_memory",
    "Insertion": "regnf_core.editing.edits",
    "OrientedBox": "regnf_core.geometry.box",
    "Registered": "regnf_core.api",
    "RegistrationOptions": "regnf_core.options",
    "RegistrationResult": "regnf_core.document",
    "RegnfError": "regnf_core.errors",
    "Removal": "regnf_core.editing.edits",
    "RenderOptions": "regnf_core.rendering.request",
    "Replacement": "regnf_core.editing.edits",
    "SdfField": "regnf_core.fields.observation",
    "Search": "regnf_core.api",
    "Sim3": "regnf_core.geometry.sim3",
    "Substitution": "regnf_core.editing.edits",
    "WarmStart": "regnf_core.robust.pipeline",
    "compose": "regnf_core.api",
    **dict.fromkeys(("from_function", "from_grid", "from_mesh", "from_points"), "regnf_core.in_memory"),
    "open_field": "regnf_core.loading",
    "register": "regnf_core.api",
    "register_batch": "regnf_core.api",
    "render": "regnf_core.api",
    "search": "regnf_core.api",
}

__all__ = [
    "BatchOutcome",
    "Camera",
    "FieldWarning",
    "Insertion",
    "OrientedBox",
    "Registered",
    "RegistrationOptions",
    "RegistrationResult",
    "RegnfError",
    "Removal",
    "RenderOptions",
    "Replacement",
    "SdfField",
    "Search",
    "Sim3",
    "Substitution",
    "WarmStart",
    "__version__",
    "compose",
    "from_function",
    "from_grid",
    "from_mesh",
    "from_points",
    "open_field",
    "register",
    "register_batch",
    "render",
    "search",
]


def __getattr__(name: str) -> object:
    if name in _HOMES:
        return getattr(importlib.import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
