"""How well a room's fitted field follows each piece of furniture in it.

A piece is what lies in an instance's box, 2 cm above the floor and up. Lengths are millimetres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import open3d
import torch
import trimesh
from numpy.typing import NDArray

from regnf_core.box import OrientedBox
from regnf_core.datasets.mesh_scene import MeshScene
from regnf_core.datasets.posed_images import PosedImages
from regnf_core.errors import NoSurfaceError
from regnf_core.fields.base import SdfField
from regnf_core.fields.neus_facto import NeusFactoField
from regnf_core.isosurface import extract_surface

Floats = NDArray[np.float64]

_POINTS = 10_000
_CELL_M = 0.008
_ABOVE_FLOOR_M = 0.02
_FLOATING_M = 0.05


@dataclass(frozen=True)
class Piece:
    """Mean errors of the field's surface and of the seen surface, NaN where the field has none. floating: the share of
    the field's surface more than 5 cm from the true scene · missing: the share of the seen surface more than 5 cm from
    the field's."""

    label: str
    from_field: float
    to_field: float
    floating: float
    missing: float


def measure_pieces(images: PosedImages, scene: MeshScene, field: SdfField, seen: Floats) -> list[Piece]:
    """One an instance. seen: (N, 3) metric points of surfaces that some camera saw."""
    assert isinstance(field, NeusFactoField)
    assert images.T_metric_world is not None
    T = images.T_metric_world
    floor = float(np.quantile(seen[:, 2], 0.001)) + _ABOVE_FLOOR_M
    return [_piece(each.label, each.box, T, scene, field, seen[seen[:, 2] > floor], floor) for each in images.instances]


def _piece(
    label: str, box: OrientedBox, T: Floats, scene: MeshScene, field: NeusFactoField, seen: Floats, floor: float
) -> Piece:
    scale = float(np.cbrt(np.linalg.det(T[:3, :3])))
    back: Floats = np.linalg.inv(T).astype(np.float64)
    corners = box.corners().numpy()
    reach = 0.05 / scale
    bounds = torch.from_numpy(np.stack((corners.min(axis=0) - reach, corners.max(axis=0) + reach)))
    own = _moved(seen, back)
    near = seen[box.contains(torch.from_numpy(own)).numpy()]
    cropped = NeusFactoField(field.function, bounds)
    resolution = int(np.ceil(float((bounds[1] - bounds[0]).max()) * scale / _CELL_M))
    try:
        surface = extract_surface(cropped, resolution)
    except NoSurfaceError:
        return Piece(label, np.nan, np.nan, 0.0, 1.0)
    mesh = trimesh.Trimesh(_moved(surface.vertices, T), surface.faces, process=False)
    sampled = trimesh.sample.sample_surface(mesh, 4 * _POINTS, seed=0)[0]
    inside = box.contains(torch.from_numpy(_moved(sampled, back))).numpy() & (sampled[:, 2] > floor)
    out = 1000.0 * np.abs(scene.signed_distance(sampled[inside]))
    # a surface within matter that no camera could see is no error
    chosen = near[np.random.default_rng(0).permutation(len(near))[:_POINTS]]
    to = 1000.0 * distances_to(mesh, chosen)
    limit = 1000.0 * _FLOATING_M
    return Piece(label, float(out.mean()), float(to.mean()), float((out > limit).mean()), float((to > limit).mean()))


def distances_to(mesh: trimesh.Trimesh, points: Floats) -> Floats:
    """(N,): distance of points (N, 3) to a mesh."""
    rays = open3d.t.geometry.RaycastingScene()
    rays.add_triangles(
        open3d.core.Tensor.from_numpy(mesh.vertices.astype(np.float32)),
        open3d.core.Tensor.from_numpy(mesh.faces.astype(np.uint32)),
    )
    distance = rays.compute_distance(open3d.core.Tensor.from_numpy(points.astype(np.float32)))
    return np.asarray(distance.numpy(), dtype=np.float64)


def _moved(points: Floats, T: Floats) -> Floats:
    moved: Floats = points @ T[:3, :3].T + T[:3, 3]
    return moved
