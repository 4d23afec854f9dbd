"""regnf_core: registration of neural signed distance fields.

    from regnf_core import OrientedBox, RegistrationOptions, open_field, register

    result = register(open_field("outputs/room/neus/run/"), open_field("chair.ply"),
                      OrientedBox.from_corners([-0.4, -0.3, 0.0], [0.1, 0.2, 0.4]))
    result.T_object_scene.matrix()   # (4, 4): scene coordinates to object coordinates

Names are resolved on first use, so that importing a torch-free part (options, errors) does not load torch.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from regnf_core.version import __version__

if TYPE_CHECKING:
    from regnf_core.errors import RegnfError
    from regnf_core.fields.base import SdfField
    from regnf_core.geometry.box import OrientedBox
    from regnf_core.geometry.sim3 import Sim3
    from regnf_core.loading import FieldWarning, open_field
    from regnf_core.options import RegistrationOptions
    from regnf_core.registration import WarmStart, register
    from regnf_core.result import RegistrationResult

_HOMES = {
    "FieldWarning": "regnf_core.loading",
    "OrientedBox": "regnf_core.geometry.box",
    "RegistrationOptions": "regnf_core.options",
    "RegistrationResult": "regnf_core.result",
    "RegnfError": "regnf_core.errors",
    "SdfField": "regnf_core.fields.base",
    "Sim3": "regnf_core.geometry.sim3",
    "WarmStart": "regnf_core.robust.pipeline",
    "open_field": "regnf_core.loading",
    "register": "regnf_core.registration",
}

__all__ = [
    "FieldWarning",
    "OrientedBox",
    "RegistrationOptions",
    "RegistrationResult",
    "RegnfError",
    "SdfField",
    "Sim3",
    "WarmStart",
    "__version__",
    "open_field",
    "register",
]


def __getattr__(name: str) -> object:
    if name in _HOMES:
        return getattr(importlib.import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
