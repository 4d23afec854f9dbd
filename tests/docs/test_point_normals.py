"""The code that estimates the normals of a scan, as docs/formats.md gives it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import open3d
import pytest

from tests.docs.pages import DOCS

SIZE = np.array([0.2, 0.12, 0.08])


def code() -> str:
    parts = (DOCS / "formats.md").read_text().split("```python\n")[1:]
    (found,) = [text for part in parts if "scan.ply" in (text := part.partition("```")[0])]
    return found


def box(count: int) -> open3d.geometry.PointCloud:
    """Points on a box, without normals."""
    open3d.utility.random.seed(1)
    mesh = open3d.geometry.TriangleMesh.create_box(*SIZE)
    return open3d.geometry.PointCloud(mesh.sample_points_uniformly(count).points)


def test_they_point_outwards(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    open3d.io.write_point_cloud(str(tmp_path / "scan.ply"), box(8_000))
    monkeypatch.chdir(tmp_path)
    exec(compile(code(), "formats.md", "exec"), {})
    found = open3d.io.read_point_cloud("scan-with-normals.ply")
    points, normals = np.asarray(found.points), np.asarray(found.normals)
    beside = np.stack([points, SIZE - points])  # how far within each pair of faces
    axis = beside.min(axis=0).argmin(axis=1)
    side = np.where(beside[0] < beside[1], -1.0, 1.0)[np.arange(len(points)), axis]
    outwards = normals[np.arange(len(points)), axis] * side
    assert len(points) > 4_000
    assert (outwards > 0.5).mean() > 0.98
