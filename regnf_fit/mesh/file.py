"""A mesh file as the target of a fit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from regnf_core.fields.mesh import MeshField
from regnf_core.importing.mesh_file import load_solid


@dataclass(frozen=True)
class MeshTarget:
    """field: the mesh, scaled if that was asked for · source: where it came from, as the fitted field records it."""

    field: MeshField
    source: dict[str, Any]


def mesh_target(mesh: Path, extent: float | None = None) -> MeshTarget:
    """The mesh in a file; with ``extent`` moved to the origin and scaled so that its longest edge has this length.

    Faces are turned as an upload's are; the source's ``mesh_faces`` says what was done to them, if anything.
    Raises what ``load_solid`` does.
    """
    target, done = load_solid(mesh)
    source: dict[str, Any] = {"mesh": mesh.name, **({"mesh_faces": list(done)} if done else {})}
    if extent is None:
        return MeshTarget(target, source)
    low, high = target.bounds.numpy()
    T_field_mesh = np.eye(4)
    T_field_mesh[:3, :3] *= extent / (high - low).max()
    T_field_mesh[:3, 3] = -T_field_mesh[0, 0] * (low + high) / 2
    return MeshTarget(target.transformed(T_field_mesh), {**source, "T_field_mesh": T_field_mesh.tolist()})
