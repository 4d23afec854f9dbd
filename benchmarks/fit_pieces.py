"""How well a room's fitted field follows each piece of furniture in it.

A piece is what lies in an instance's box, 2 cm above the floor and up. Lengths are millimeters. A field has a surface
round what no camera saw as well, under a seat for instance: what lies more than 5 cm from the true scene is counted on
its own, and left out of the mean.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import open3d
import torch
import trimesh
from numpy.typing import NDArray

from benchmarks.worlds.mesh_scene import MeshScene
from regnf_core.errors import NoSurfaceError
from regnf_core.fields.neus_facto import NeusFactoField
from regnf_core.fields.observation import SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.surface.isosurface import extract_surface
from regnf_data.posed_images import PosedImages

Floats = NDArray[np.float64]

_POINTS = 10_000
_CELL_M = 0.008
_ABOVE_FLOOR_M = 0.02
_LIMIT_MM = 50.0


@dataclass(frozen=True)
class Piece:
    """Mean errors of the field's surface and of the seen surface, NaN where the field has none. beyond: the share of
    the field's surface more than 5 cm from the true scene, left out of ``from_field`` · missing: the share of the seen
    surface more than 5 cm from the field's."""

    label: str
    from_field: float
    to_field: float
    beyond: float
    missing: float


def measure_pieces(images: PosedImages, scene: MeshScene, field: SdfField, seen: Floats) -> tuple[Piece, ...]:
    """One an instance. seen: (N, 3) metric points of surfaces that some camera saw."""
    assert isinstance(field, NeusFactoField)
    assert images.T_metric_world is not None
    T = images.T_metric_world
    floor = float(np.quantile(seen[:, 2], 0.001)) + _ABOVE_FLOOR_M
    high = seen[seen[:, 2] > floor]
    return tuple(_piece(each.label, each.box, T, scene, field, high, floor) for each in images.instances)


def _piece(
    label: str, box: OrientedBox, T: Floats, scene: MeshScene, field: NeusFactoField, seen: Floats, floor: float
) -> Piece:
    scale = float(np.cbrt(np.linalg.det(T[:3, :3])))
    back: Floats = np.linalg.inv(T).astype(np.float64)
    corners = box.corners().numpy()
    reach = 0.05 / scale
    bounds = torch.from_numpy(np.stack((corners.min(axis=0) - reach, corners.max(axis=0) + reach)))
    own = moved(seen, back)
    near = seen[box.contains(torch.from_numpy(own)).numpy()]
    cropped = NeusFactoField(field.function, bounds)
    resolution = int(np.ceil(float((bounds[1] - bounds[0]).max()) * scale / _CELL_M))
    try:
        surface = extract_surface(cropped, resolution)
    except NoSurfaceError:
        return Piece(label, np.nan, np.nan, 0.0, 1.0)
    mesh = trimesh.Trimesh(moved(surface.vertices, T), surface.faces, process=False)
    sampled = trimesh.sample.sample_surface(mesh, 4 * _POINTS, seed=0)[0]
    inside = box.contains(torch.from_numpy(moved(sampled, back))).numpy() & (sampled[:, 2] > floor)
    out = 1000.0 * np.abs(scene.signed_distance(sampled[inside]))
    chosen = near[np.random.default_rng(0).permutation(len(near))[:_POINTS]]
    to = 1000.0 * distances_to(mesh, chosen)
    beyond = out > _LIMIT_MM
    return Piece(
        label, float(out[~beyond].mean()), float(to.mean()), float(beyond.mean()), float((to > _LIMIT_MM).mean())
    )


def distances_to(mesh: trimesh.Trimesh, points: Floats) -> Floats:
    """(N,): distance of points (N, 3) to a mesh."""
    rays = open3d.t.geometry.RaycastingScene()
    rays.add_triangles(
        open3d.core.Tensor.from_numpy(mesh.vertices.astype(np.float32)),
        open3d.core.Tensor.from_numpy(mesh.faces.astype(np.uint32)),
    )
    distance = rays.compute_distance(open3d.core.Tensor.from_numpy(points.astype(np.float32)))
    return np.asarray(distance.numpy(), dtype=np.float64)


def moved(points: Floats, T: Floats) -> Floats:
    """Points (N, 3) by a transform (4, 4)."""
    placed: Floats = points @ T[:3, :3].T + T[:3, 3]
    return placed
