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
    from regnf_core.api import Registered, Search, compose, register, register_batch, render, search
    from regnf_core.batch import BatchOutcome
    from regnf_core.document import RegistrationResult
    from regnf_core.editing.edits import Insertion, Removal, Replacement, Substitution
    from regnf_core.errors import RegnfError
    from regnf_core.fields.observation import SdfField
    from regnf_core.geometry.box import OrientedBox
    from regnf_core.geometry.sim3 import Sim3
    from regnf_core.in_memory import FieldWarning, from_function, from_grid, from_mesh, from_points
    from regnf_core.loading import open_field
    from regnf_core.options import RegistrationOptions
    from regnf_core.population.calls import Changes, compare, populate
    from regnf_core.population.populate import Population
    from regnf_core.rendering.camera import Camera
    from regnf_core.rendering.request import RenderOptions

_NAMES = {
    "api": ("Registered", "Search", "compose", "register", "register_batch", "render", "search"),
    "batch": ("BatchOutcome",),
    "document": ("RegistrationResult",),
    "editing.edits": ("Insertion", "Removal", "Replacement", "Substitution"),
    "errors": ("RegnfError",),
    "fields.observation": ("SdfField",),
    "geometry.box": ("OrientedBox",),
    "geometry.sim3": ("Sim3",),
    "in_memory": ("FieldWarning", "from_function", "from_grid", "from_mesh", "from_points"),
    "loading": ("open_field",),
    "options": ("RegistrationOptions",),
    "population.calls": ("Changes", "compare", "populate"),
    "population.populate": ("Population",),
    "rendering.camera": ("Camera",),
    "rendering.request": ("RenderOptions",),
}
_HOMES = {name: f"{__name__}.{module}" for module, names in _NAMES.items() for name in names}
__all__ = [
    "BatchOutcome", "Camera", "Changes", "FieldWarning", "Insertion", "OrientedBox", "Population", "Registered",
    "RegistrationOptions", "RegistrationResult", "RegnfError", "Removal", "RenderOptions", "Replacement", "SdfField",
    "Search", "Sim3", "Substitution", "__version__", "compare", "compose", "from_function", "from_grid", "from_mesh",
    "from_points", "open_field", "populate", "register", "register_batch", "render", "search",
]  # fmt: skip


def __getattr__(name: str) -> object:
    if name in _HOMES:
        return getattr(importlib.import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
