"""Point clouds as uploads: the surface between the points against the formula it was sampled from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from regnf_core.fields.build import open_field
from regnf_core.fields.mesh import MeshField
from regnf_core.importing.families import point_cloud
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.families.mesh import convert_mesh
from regnf_core.importing.gate.gate import import_field
from regnf_core.importing.upload_description import UploadDescription
from tests.core.importing.archives import assert_refused, saved

DIAGONAL = 3**0.5


def directions(count: int) -> NDArray[np.float64]:
    """Spread evenly over the unit sphere."""
    turn, height = np.pi * (1 + 5**0.5) * np.arange(count), 1 - (2 * np.arange(count) + 1) / count
    ring = np.sqrt(1 - height**2)
    return np.stack((ring * np.cos(turn), ring * np.sin(turn), height), axis=1)


def ply(points: NDArray[np.float64], normals: NDArray[np.float64] | None = None) -> bytes:
    names = ("x", "y", "z") + (() if normals is None else ("nx", "ny", "nz"))
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
    header += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    return header.encode() + np.hstack([points] + ([] if normals is None else [normals])).astype("<f4").tobytes()


def converted(data: bytes) -> ConvertedField:
    return convert_mesh("ply", memoryview(data), UploadDescription())


def field_of(found: ConvertedField) -> MeshField:
    return MeshField(found.tensors["vertices"], found.tensors["faces"])


def test_points_at_one_place_are_compared_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """100,000 of them, each compared with each, took longer than any import may."""
    built: list[NDArray[np.float64]] = []

    def tree(places: NDArray[np.float64]) -> Any:
        built.append(places)
        return cKDTree(places)

    monkeypatch.setattr(point_cloud, "cKDTree", tree)
    around = directions(400)
    again = np.concatenate((around, around[:20].repeat(50, axis=0)))
    assert len(field_of(converted(ply(again, again))).faces) > 1000
    assert len(built[0]) == 400


def test_points_on_a_sphere_are_a_sphere(tmp_path: Path) -> None:
    around = directions(4000)
    upload = saved(tmp_path, ply(100.0 + 0.5 * around, 3.0 * around))  # elsewhere, with normals of any length
    report = import_field(upload, tmp_path / "out", {"label": "ball"})
    assert (report.family, report.label) == ("point_cloud", "ball")
    assert report.why[0] == "a ply file: 4000 points with normals"
    assert [warning.split(":")[0] for warning in report.warnings] == ["SURFACE_RECONSTRUCTED"]
    points = 100.0 + torch.rand(2000, 3, generator=torch.Generator().manual_seed(0)) * 1.4 - 0.7
    distance, gradient = open_field(tmp_path / "out" / "field.safetensors").signed_distance_and_gradient(points)
    radius = (points - 100.0).norm(dim=1)
    torch.testing.assert_close(distance, radius - 0.5, rtol=0, atol=0.002 * DIAGONAL)
    assert ((gradient * (points - 100.0)).sum(dim=1) / radius)[radius > 0.1].min() > 0.98


def test_where_no_points_are_there_is_no_surface() -> None:
    """Poisson's surface is closed; the half of it that nobody measured is cut away."""
    around = directions(8000)
    seen = around[around[:, 2] > 0]
    field = field_of(converted(ply(0.5 * seen, seen)))
    far = torch.tensor([[0.0, 0.0, -0.5], [0.0, 0.0, -0.3]])
    assert (field.signed_distance(far).abs() > 0.25).all()
    assert field.signed_distance(torch.tensor([[0.0, 0.0, 0.5]])).abs().item() < 0.003


@pytest.mark.parametrize(
    ("points", "normals", "reason"),
    [
        (directions(500), None, "POINT_CLOUD_WITHOUT_NORMALS"),
        (directions(50), directions(50), "MESH_INVALID"),
        (directions(500), np.zeros((500, 3)), "MESH_INVALID"),
        (np.full((500, 3), np.nan), directions(500), "MESH_INVALID"),
        (np.zeros((500, 3)), directions(500), "MESH_INVALID"),
        (np.zeros((0, 3)), None, "MESH_INVALID"),
    ],
)
def test_clouds_of_no_surface(points: NDArray[np.float64], normals: NDArray[np.float64] | None, reason: str) -> None:
    assert_refused(lambda: converted(ply(points, normals)), reason)
