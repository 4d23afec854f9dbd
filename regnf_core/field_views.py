"""What people look at of a stored field. Torch-free."""

from __future__ import annotations

from dataclasses import dataclass

PICTURE_NAME = "preview.png"
MESH_NAMES = ("mesh.glb", "mesh-coarse.glb")
"""Fine and coarse."""


@dataclass(frozen=True)
class FieldViews:
    """The bytes of two GLB files and a PNG; None for what there is not. There is no coarse mesh of a small surface."""

    fine: bytes | None = None
    coarse: bytes | None = None
    picture: bytes | None = None

    def files(self) -> dict[str, bytes]:
        """What there is, by name."""
        found = zip((*MESH_NAMES, PICTURE_NAME), (self.fine, self.coarse, self.picture), strict=True)
        return {name: data for name, data in found if data is not None}
